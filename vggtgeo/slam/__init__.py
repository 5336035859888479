"""The SLAM pipeline: a fold over frames."""
