"""Saccade: an active-vision agent made of independent services."""
