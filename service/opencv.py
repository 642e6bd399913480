"""The only door to OpenCV: ``from service.opencv import cv2``. Its limit of pixels is set where the package begins."""

import cv2 as cv2

# parallel work is one pool of threads, sized by the settings
cv2.setNumThreads(1)

__all__ = ["cv2"]
