"""The sliding window: the adjustment of the newest keyframes, and what those that left it said."""
