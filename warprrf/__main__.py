"""`python -m warprrf`: the command line."""

import sys

from warprrf.cli import main

if __name__ == "__main__":
    sys.exit(main())
