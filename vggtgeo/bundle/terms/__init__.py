"""The terms of the energy: a residual of ONE observation, its data, its weights, its robust kernel.

| kind, by its unknowns | residual | terms of the package |
|---|---|---|
| `SlotTerm`: a landmark | `residual(inverse_depth)` | `DepthPrior` |
| `HostPixel`: the pixel of a landmark in its host | `residual(offset)` | `HostPixel` |
| `EdgeTerm`: a landmark seen along an edge | `residual(view)` | `PointTerm`, `LineTerm` |
| `PairTerm`: two poses | `residual(pose_i, pose_j)` | `RelativePose`, `SurfaceAlignment`, `BaselinePrior` |
| `PoseTerm`: a pose and the camera | `residual(pose, camera)` | `RotationPrior` |
| `CameraTerm`: the camera | `residual(parameters)` | `IntrinsicsPrior` |
| `DenseTerm`: all poses and the camera | `residual(poses, parameters)` | `MarginalPrior` |

`vggtgeo/bundle/linearise.py` builds the normal equations of any tuple of them.
"""
