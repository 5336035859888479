"""The map of keyframes: what each saw, which see the same, what ties their poses, its pieces."""
