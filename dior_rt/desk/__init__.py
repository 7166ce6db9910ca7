"""The light desk: a page on this machine where the user draws light on a photo. It needs the extra `desk`."""
