"""Dense maps: depth of every keyframe, and the point cloud and mesh fused from it."""
