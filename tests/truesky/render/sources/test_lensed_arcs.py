import numpy as np
import pytest

from truesky.render.sources.lensed_arcs import Picture


@pytest.mark.parametrize("along", [0, 1])
def test_half_of_the_light_of_a_stretched_picture(along):
    """Half of the light of a line along one axis is in its inner half, whatever the step along the other axis is."""
    image = np.zeros((41, 41), np.float32)
    image[20, :] = 1.0 / 41
    picture = Picture(image if along == 0 else image.T, np.diag([-0.05, 0.02]))
    assert picture.half_light == pytest.approx(41 / 4 * (0.05, 0.02)[along], abs=0.03)


def test_half_of_the_light_of_a_sheared_picture():
    """Steps along rows and columns differ and are not orthogonal. The reference sums the pixels."""
    rng = np.random.default_rng(3)
    image = rng.random((30, 50)).astype(np.float32)
    image /= image.sum()
    matrix = np.array([[-0.06, 0.01], [0.02, 0.03]])
    radius = {(y, x): np.hypot(*(matrix @ [x - 24.5, y - 14.5])) for y, x in np.ndindex(image.shape)}
    light = 0.0
    for y, x in sorted(radius, key=radius.get):
        light += image[y, x]
        if light > 0.5:
            break
    assert Picture(image, matrix).half_light == pytest.approx(radius[y, x], abs=0.03)
