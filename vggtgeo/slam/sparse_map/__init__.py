"""The sparse map: keyframes, their covisibility, factors on their poses, and connected components."""
