"""Benchmark: error against run time, and what happens in extreme cases. `medcolor bench` runs it (`run.run_bench`).

| file | question |
| --- | --- |
| `pairs` | pictures whose true colours are known |
| `quality` | how far colours are from the true ones; trivial methods to beat |
| `matched` | one slice through the pipeline, opened up |
| `suite_pipeline`, `regions` | the whole way: error by preset, layer, features, smoother, and its time |
| `suite_smoothing`, `exact_smoothing` | smoothers against exact solutions |
| `suite_correspondence` | searches against the exhaustive one, and against the known map |
| `suite_features` | features by precision |
| `stability`, `stability_*` | stiff and extreme cases, with a verdict each |
| `summary`, `tables`, `schema` | one line per method, targets; what is stored and how it is checked |
| `plots`, `page` | diagrams and the HTML page |

The method is in `Testing/Benchmark/README.md`. Nothing here is imported by the rest of the library.
"""
