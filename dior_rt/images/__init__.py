"""Files in and out: photos with their colour profiles and metadata, strokes, Lumi maps, and arrays."""
