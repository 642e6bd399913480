"""The only door to SciPy, which takes a sixth of a start and 45 MB: whoever serves opens it when a sheet comes."""

from scipy.interpolate import RectBivariateSpline as RectBivariateSpline
from scipy.ndimage import correlate1d as correlate1d
from scipy.optimize import least_squares as least_squares
from scipy.optimize import minimize_scalar as minimize_scalar
from scipy.spatial import cKDTree as cKDTree
from scipy.special import chndtr as chndtr
from scipy.special import ndtr as ndtr
from scipy.special import stdtrit as stdtrit
from threadpoolctl import threadpool_limits

# the sums of a calibration are small: more threads would wait for each other
threadpool_limits(1, "blas")
