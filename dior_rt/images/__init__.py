"""Read and write photos with their colour profiles and metadata, strokes, Lumi maps, and arrays."""
