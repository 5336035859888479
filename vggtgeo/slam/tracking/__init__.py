"""Where a frame is: placed against a keyframe and the map, judged by evidence, placed again when the map is done."""
