"""From trained weights to a bundle: merge, convert, check. Imported as ``dior_rt.export``; needs the extra."""
