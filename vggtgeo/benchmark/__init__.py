"""Suites of runs, and their tables: sequences x settings x seeds, each run in a process of its own.

| file | job |
|---|---|
| `suite` | the TOML file and its checks; `protocols`: how others compare |
| `jobs` | the runs of a suite, each with all it depends on |
| `inputs`, `worker`, `measure` | one run: what it looks at, the run, its row of numbers |
| `processes`, `scheduling` | a process with limits; many of them in turn or side by side |
| `cluster` | the same on a Ray cluster |
| `store`, `provenance` | finished runs as folders, so that a second call goes on; where numbers come from |
| `table`, `statistics`, `cells` | CSV and Parquet; means, intervals, paired differences |
| `external`, `published` | trajectories of other systems; figures that others published, shown apart |
| `markdown`, `figures`, `page` | tables, drawings, the HTML page |
| `runner` | all of it in order: `vggtgeo.bench` |

The package is not called `bench`, as `vggtgeo.bench` is the function.
"""
