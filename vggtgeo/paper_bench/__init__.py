"""The tables of the paper in simulation: built-in worlds, stubs of the five roles, ablations, several seeds.

Every number that comes out of here is simulated and is called so.

| file | job |
|---|---|
| `courses` | which walks through which worlds, how long and how dense |
| `variants` | what is switched off or exchanged |
| `plan` | which variant runs where, on how many seeds |
| `stage` | a walk rendered once for all variants of a seed, and the stubs that look at it |
| `measure` | one run and its errors |
| `store` | finished runs as files, so that a second call goes on where the first ended |
| `tables`, `figure` | means and standard deviations as Markdown, CSV and a picture |
| `runner` | all of it in order: `vggtgeo.bench` |
"""
