"""The service: photographs in, metres out. Here is what libraries read once, when they are first imported."""

import os

# OpenCV's own limit lets a 600 kB file take gigabytes
PIXEL_CEILING = 100_000_000
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(PIXEL_CEILING))
os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")

# ONNX Runtime would send what machine this is to its makers, and leave files in the user's home
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

# huge pages for NumPy's arrays are found by compacting memory: a photograph of 12 megapixels stalls up to a second
os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
