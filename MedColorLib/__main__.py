"""`python -m MedColorLib` is the command `medcolor`."""

import sys

from .cli.main import main

if __name__ == "__main__":
    sys.exit(main())
