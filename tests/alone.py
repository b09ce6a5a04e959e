"""One thread of linear algebra for each worker: there are as many workers as cores.

Imported before NumPy, which reads this once.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
