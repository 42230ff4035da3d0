"""Pictures of moving things: captures read, written, checked and rendered; files of Gaussians."""
