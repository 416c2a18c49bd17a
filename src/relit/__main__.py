"""`python -m relit`: the same as the `relit` command."""

import sys

from relit.cli import main

if __name__ == "__main__":
    sys.exit(main())
