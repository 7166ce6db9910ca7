"""Many photos in one go: find them, match each with its strokes, relight them, and remember what is done."""
