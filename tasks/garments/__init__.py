"""Builds the dataset ``garments``: a body, motions, patterns and a cloth simulation. Only this room needs the extra
``garments``; reading the shipped data (``tasks.datasets.garments``) does not."""
