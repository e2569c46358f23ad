"""Matching: which place of the photograph looks like each place of the scan, and how far that can be trusted."""
