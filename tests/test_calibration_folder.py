"""A folder of photographs as a calibration takes them."""

from pathlib import Path

import numpy as np
import pytest

from service.commands.calibration_folder import pictures_in
from service.errors import InvalidImage
from service.inference.images import ImageLimits
from service.opencv import cv2


def test_a_file_that_cannot_be_read_is_told_of_as_one_photograph_s_fault(tmp_path: Path) -> None:
    (tmp_path / "a folder.jpg").mkdir()
    (tmp_path / "gone.jpg").symlink_to(tmp_path / "nowhere.jpg")
    cv2.imwrite(str(tmp_path / "there.png"), np.full((30, 40, 3), 90, np.uint8))
    folder, gone, there = pictures_in(tmp_path, ImageLimits())
    for picture in (folder, gone):
        with pytest.raises(InvalidImage, match="cannot be read"):
            picture.load()
    assert (there.load().rgb.shape, there.load().f_number) == ((30, 40, 3), None)
