"""Lumen: the network that first reads the scene from a photo and then completes the drawn light."""
