"""The light desk: a page on this machine where light is drawn on a photo; the extra `desk`."""
