"""Qwen-Image-Edit as a model family."""
