"""Renders, triplets, networks, LoRA and evaluation. Imported as ``dior_rt.training``; needs the extra."""
