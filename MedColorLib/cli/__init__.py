"""Command line: words become one call of the library; a failure becomes one sentence and an exit status."""
