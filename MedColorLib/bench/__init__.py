"""Benchmark: error against run time, and what happens in extreme cases. `medcolor bench` runs it (`run.run_bench`).

| file | question |
| --- | --- |
| `pairs` | pictures whose true colours are known |
| `quality` | how far colours are from the true ones; trivial methods to beat |
| `matched` | one slice through the pipeline, opened up, with switches for what is not in the paper |
| `suite_pipeline`, `regions` | the whole way: error by preset, layer, features, smoother, and its time |
| `suite_quality`, `slabs` | what each improvement on the paper brings; coherence along the stack |
| `suite_smoothing`, `exact_smoothing` | smoothers against exact solutions |
| `suite_correspondence` | searches against the exhaustive one, and against the known map |
| `suite_features` | features by precision |
| `suite_profile`, `stopwatch`, `work`, `machine` | where the time of a slice goes, and how far that is from the limit |
| `suite_sidebyside`, `plain_patchmatch` | the same work by others: PatchMatch as published, OpenCV's filters |
| `suite_scaling`, `peak_memory` | growth of time with size, and of memory with slices |
| `stability`, `stability_*` | stiff and extreme cases, with a verdict each |
| `summary`, `tables`, `schema` | one line per method, targets; what is stored and how it is checked |
| `expected_error_table` | from a stored result to the error that is told before a run |
| `plots`, `plots_suites`, `page` | diagrams and the HTML page |

The method is in `Testing/Benchmark/README.md`. Nothing here is imported by the rest of the library.
"""
