"""Benchmark: error against run time, and what happens in extreme cases. `medcolor bench` runs it.

| file | question |
| --- | --- |
| `pairs` | pictures whose true colours are known |
| `quality` | how far the pipeline's colours are from the true ones, and how long it takes |
"""
