"""What becomes of a pair on its way to int8."""

import torch

from model_export.networks import make_pair
from model_export.quantized import Cells, through_cells


def test_a_picture_in_cells_is_the_same_picture() -> None:
    picture = torch.arange(2 * 3 * 4 * 6, dtype=torch.float32).reshape(2, 3, 4, 6)
    torch.testing.assert_close(Cells(3)(picture), torch.nn.functional.pixel_unshuffle(picture, 2))


def test_through_cells_the_answers_are_the_same() -> None:
    torch.manual_seed(0)
    pair = make_pair("compact")
    pair.modules().eval()
    image = torch.rand(1, 3, 64, 96)
    with torch.inference_mode():
        in_cells, as_it_was = through_cells(pair).blur(image), pair.blur(image)
    assert any(isinstance(module, Cells) for module in through_cells(pair).blur.modules())
    assert not any(isinstance(module, Cells) for module in pair.blur.modules())
    torch.testing.assert_close(in_cells.blur_px, as_it_was.blur_px, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(in_cells.features[0], as_it_was.features[0], rtol=1e-4, atol=1e-5)
