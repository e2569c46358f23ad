"""Cohorts: a folder of volumes becomes a folder of results, one volume at a time, in processes or on a Dask cluster."""
