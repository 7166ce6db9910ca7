"""Random scenes as plain data: shapes, textures, skies, and the builders that combine them."""
