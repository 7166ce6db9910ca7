"""Lumen: the network that reads a photo's scene first and then completes the light that is drawn on it."""
