"""Benchmark suites: sequences x settings x seeds, each run in its own process, and their tables.

| file | job |
|---|---|
| `suite` | the TOML file and its validation; `protocols`: evaluation protocols of other systems |
| `jobs` | the runs of a suite, each with everything its result depends on |
| `inputs`, `worker`, `measure` | one run: its input, the run itself, its row of numbers |
| `processes`, `scheduling` | a process with limits; many of them, serial or parallel |
| `cluster` | the same on a Ray cluster |
| `store`, `provenance` | finished runs as folders, reused by a second call; versions, machine, input digests |
| `table`, `statistics`, `cells` | CSV and Parquet; means, intervals, paired differences |
| `external`, `published` | trajectories of other systems; figures published by others, shown separately |
| `markdown`, `figures`, `page` | tables, figures, the HTML report |
| `runner` | all of it: `vggtgeo.bench` |

The package is not called `bench`, as `vggtgeo.bench` is the function.
"""
