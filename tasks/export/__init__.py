"""What is made, in the formats of other programs."""
