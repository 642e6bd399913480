"""The service: photographs in, metres out."""

import os

# NumPy reads it when it is first imported. Huge pages for its large arrays are found by compacting memory, which stalls
# a photograph of 12 megapixels by up to a second.
os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
