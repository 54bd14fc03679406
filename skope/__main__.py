"""Entry point of the `skope` command."""

import os

# NumPy reads this when it is imported. Matrices are small here: on several cores, OpenBLAS takes a quarter more
# processor time, and no less time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from skope.cli import main

if __name__ == "__main__":
    main()
