"""Dense maps: depth of every keyframe, the cloud and the mesh that are fused of it."""
