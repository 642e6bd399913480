"""The only door to OpenCV: ``from service.opencv import cv2``.

OpenCV reads its pixel limit once, when it is loaded, and its own default lets a 600 kB file take gigabytes.
"""

import os

PIXEL_CEILING = 100_000_000
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(PIXEL_CEILING))
os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")

import cv2 as cv2  # noqa: E402

# parallel work is one pool of threads, sized by the settings
cv2.setNumThreads(1)

__all__ = ["PIXEL_CEILING", "cv2"]
