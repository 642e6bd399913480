"""What the compact pair sees beside the pixels: how much detail there is in bands of frequency, none of it learned."""

import torch
from torch import Tensor, nn
from torch.nn import functional

LUMINANCE = (0.299, 0.587, 0.114)
BLOCK = 16  # maps that ONNX Runtime computes at a time
CELL = 4  # pixels of 2x2


def _gaussian(sigma: float, radius: int) -> Tensor:
    """Taps [2 radius + 1] that sum to 1; sigma 0 leaves a picture as it is."""
    t = torch.arange(-radius, radius + 1, dtype=torch.float64)
    g = torch.exp(-0.5 * (t / max(sigma, 1e-6)) ** 2)
    return g / g.sum()


class BandEnergy(nn.Module):
    """Log energy of twelve luminance bands, three an octave, from 0.6 px up: [n,12,h/2,w/2].

    Bands are differences of Gaussians on a pyramid whose next level starts where this one's Gaussian has
    doubled, so each octave costs a quarter of the one before; each energy is smoothed at 1.2 px of its level.
    Beyond the picture its edge goes on. The first octave is computed in cells of 2x2: its energies are needed at half
    size alone, so each of its Gaussians is four maps of that size, a pixel of the cell each, which the smoothing sums.
    """

    OCTAVES = 4
    BANDS = 3
    FIRST_SIGMA = 0.6
    SMOOTH_SIGMA = 1.2
    RADIUS = 4
    FLOOR = 1e-6
    luminance: Tensor
    first_across: Tensor
    first_down: Tensor
    first_bands: Tensor
    first_rows: Tensor
    first_columns: Tensor
    first_sums: Tensor
    across: Tensor
    down: Tensor
    bands: Tensor
    rows: Tensor
    columns: Tensor

    def __init__(self) -> None:
        super().__init__()
        sigmas = [self.FIRST_SIGMA * 2 ** (i / self.BANDS) for i in range(self.BANDS + 1)]
        # later levels start from a picture that is blurred by FIRST_SIGMA already
        more = [max(s * s - self.FIRST_SIGMA**2, 0.0) ** 0.5 for s in sigmas]
        first, later = (torch.stack([_gaussian(s, self.RADIUS) for s in several]) for several in (sigmas, more))
        smooth = _gaussian(self.SMOOTH_SIGMA, self.RADIUS)
        number, pixel = torch.arange(BLOCK) // CELL, torch.arange(BLOCK) % CELL
        # taps on a cell and those around it: from its first pixel and its second one, and to a sum of both
        from_cell = torch.stack([functional.pad(first, (0, 1)), functional.pad(first, (1, 0))])
        to_cell = functional.pad(smooth, (0, 1)).reshape(-1, 2).T
        later = functional.pad(later, (0, 0, 0, BLOCK - len(later)))
        self._keep("luminance", torch.tensor(LUMINANCE)[None])
        self._keep("first_across", from_cell[pixel % 2, number][:, None, None, :])
        self._keep("first_down", from_cell[pixel // 2, number][:, None, :, None])
        self._keep("first_bands", self._differences(CELL))
        self._keep("first_rows", to_cell[pixel % 2][:, None, None, :])
        self._keep("first_columns", to_cell[pixel // 2][:, None, :, None])
        self._keep("first_sums", (number == torch.arange(self.BANDS)[:, None])[:, :, None, None])
        self._keep("across", later[:, None, None, :])
        self._keep("down", later[:, None, :, None])
        self._keep("bands", self._differences(1)[: self.BANDS + 1])
        self._keep("rows", smooth.repeat(self.BANDS, 1)[:, None, None, :])
        self._keep("columns", smooth.repeat(self.BANDS, 1)[:, None, :, None])

    def _differences(self, step: int) -> Tensor:
        """Gaussians of ``step`` maps each to the bands between neighbours [k,k,1,1]; the last Gaussian stays."""
        bands = torch.eye(BLOCK)
        bands[: self.BANDS * step] -= torch.eye(BLOCK)[step : step + self.BANDS * step]
        return bands[:, :, None, None]

    def _keep(self, name: str, values: Tensor) -> None:
        self.register_buffer(name, values.float(), persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        n, c, h, w = image.shape
        level = torch.matmul(self.luminance, image.reshape(n, c, h * w)).reshape(n, 1, h, w)
        energies = []
        for octave in range(self.OCTAVES):
            # room for a band and for the smoothing of its energy
            padded = functional.pad(level, (2 * self.RADIUS,) * 4, mode="replicate")
            energy, level = self._later_octave(padded) if octave else self._first_octave(padded)
            energy = torch.log(energy + self.FLOOR)
            if octave > 1:
                factor = 2.0 ** (octave - 1)
                energy = functional.interpolate(energy, scale_factor=factor, mode="bilinear", align_corners=False)
            energies.append(energy)
        return torch.cat(energies, 1) * 0.25 + 2.0

    def _first_octave(self, padded: Tensor) -> tuple[Tensor, Tensor]:
        """Energies and the next level, both at half size: maps are cells already."""
        across = functional.conv2d(padded, self.first_across, stride=(1, 2))
        blurred = functional.conv2d(across, self.first_down, stride=(2, 1), groups=BLOCK)
        seen = functional.conv2d(blurred, self.first_bands)
        rows = functional.conv2d(seen * seen, self.first_rows, groups=BLOCK)
        energy = functional.conv2d(functional.conv2d(rows, self.first_columns, groups=BLOCK), self.first_sums)
        margin, last = self.RADIUS // 2, CELL * self.BANDS
        return energy, seen[:, last : last + 1, margin:-margin, margin:-margin]

    def _later_octave(self, padded: Tensor) -> tuple[Tensor, Tensor]:
        """Energies at the size of the level, and the next level at half of it."""
        across = functional.conv2d(padded, self.across)
        seen = functional.conv2d(functional.conv2d(across, self.down, groups=BLOCK), self.bands)
        rows = functional.conv2d(seen[:, : self.BANDS] ** 2, self.rows, groups=self.BANDS)
        energy = functional.conv2d(rows, self.columns, groups=self.BANDS)
        margin = self.RADIUS
        return energy, seen[:, -1:, margin:-margin:2, margin:-margin:2]
