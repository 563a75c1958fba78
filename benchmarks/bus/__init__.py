"""Measures how long a camera image takes from one process to another, over our bus and over others, in one run."""
