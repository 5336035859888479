"""Benchmark suites: sequences x settings x seeds, each run in its own process, and their tables.

| file | job |
|---|---|
| `suite` | the TOML file, its validation, evaluation protocols of other systems |
| `jobs` | the runs of a suite, each with everything its result depends on; finished runs as folders |
| `inputs`, `worker`, `measure` | one run: its input, the run itself, its row of numbers |
| `processes` | many runs, serial or parallel, each in a process with limits |
| `cluster` | the same on a Ray cluster |
| `provenance` | versions, machine, digests of inputs |
| `rows` | the rows of all runs: CSV and Parquet; means, intervals, paired differences |
| `tables`, `figures` | content of the report; published results of other systems in separate tables |
| `report` | the report as Markdown and as HTML |
| `runner` | `vggtgeo.bench`: runs, tables and trajectories of other systems |

The package is not called `bench`, as `vggtgeo.bench` is the function.
"""
