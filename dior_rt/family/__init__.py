"""The model families: how each turns a photo and strokes into network inputs, and outputs into light."""
