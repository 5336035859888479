"""The camera where it is not known, or not well: focal length, lens, shutter, what of the picture stays still."""
