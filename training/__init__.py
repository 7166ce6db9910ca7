"""Renders, triplets, networks, LoRA and evaluation. Import it as ``dior_rt.training``; it needs the extra."""
