"""Relight many photos: find them, match each with its strokes, relight them, and record what is done."""
