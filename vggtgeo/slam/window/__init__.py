"""The sliding window: adjustment of the newest keyframes, with a marginal prior from older ones."""
