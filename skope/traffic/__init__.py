"""Traffic from tracks: events at gates, zones and lanes, counts, movements, speeds, queues, conflicts.

Measures are pure functions over `Track` in metres and seconds, and report their uncertainty. `measure` runs them in
order. docs/traffic-files.md has the definitions.
"""
