"""Stage *correspondence*: which reference position looks like each target position.

A nearest-neighbour field (NNF) is an int64 tensor (N, h, w) of flat row-major indices into the (h2, w2) map of the other
side. `field.py` holds what can be done with one; the searches are interchangeable:

| file | search | when |
| --- | --- | --- |
| `exact.py` | every position against every position, as one matrix product | wherever the matrix fits: coarse layers |
| `patches.py` | the same as a product of whole patches in bfloat16 | own features, where a CPU multiplies bfloat16 |
| `windowed.py` | every position of a window around the start, as small matrix products | fine layers of `full` |
| `patchmatch.py` | propagation and random search around a start (Barnes et al. 2009), as in the paper | to compare with |
"""
