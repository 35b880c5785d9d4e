import math

import pytest
import torch

from styleexp.method import views
from styleexp.method.options import LocalViewsConfig, ViewsConfig


def project(cameras, point):
    """NDC of a world point in every camera, by the contract in renderers/base.py."""
    q = cameras.rotation @ torch.as_tensor(point, dtype=torch.float32) + cameras.translation
    return cameras.focal * q[:, :2] / -q[:, 2:] + cameras.center


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


def test_azimuth_zero_looks_from_plus_z_and_ninety_degrees_from_plus_x():
    cameras = views.orbit(torch.zeros(2), torch.tensor([0.0, math.pi / 2]), 2.0, 60.0)
    eyes = -(cameras.rotation.transpose(1, 2) @ cameras.translation[:, :, None]).squeeze(-1)
    torch.testing.assert_close(eyes, torch.tensor([[0.0, 0, 2], [2, 0, 0]]), atol=1e-6, rtol=0)
    right_then_up = project(cameras, [0.1, 0.2, 0.0])[0]
    assert right_then_up[0] > 0
    assert right_then_up[1] > 0


def test_the_unit_sphere_touches_the_frame_at_the_papers_distance_and_field_of_view():
    camera = views.orbit(torch.zeros(1), torch.zeros(1), 2.0, 60.0)
    tangent = [0.0, math.cos(math.pi / 6), math.sin(math.pi / 6)]  # where the sight line touches
    assert project(camera, tangent)[0, 1] == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("elevation", [math.pi / 2, -math.pi / 2, 3.0])
def test_poles_are_guarded(elevation):
    camera = views.orbit(torch.tensor([elevation]), torch.zeros(1), 2.0, 60.0)
    gram = camera.rotation[0] @ camera.rotation[0].T
    torch.testing.assert_close(gram, torch.eye(3), atol=1e-5, rtol=0)


def test_first_view_is_the_centre_and_others_spread_as_configured():
    config = ViewsConfig(spread="normal", elevation=10, azimuth=20, azimuth_std=45)
    cameras = views.sample_global(config, rng(), 2000)
    centre = views.orbit(
        torch.tensor([math.radians(10)]), torch.tensor([math.radians(20)]), 2.0, 60.0
    )
    torch.testing.assert_close(cameras.rotation[0], centre.rotation[0])
    eyes = -(cameras.rotation.transpose(1, 2) @ cameras.translation[:, :, None]).squeeze(-1)
    azimuth = torch.atan2(eyes[:, 0], eyes[:, 2])
    assert math.degrees(azimuth.median()) == pytest.approx(20, abs=5)


def test_views_around_leave_no_side_out():
    cameras = views.sample_global(ViewsConfig(spread="around", count=8), rng())
    azimuth = torch.atan2(cameras.rotation[:, 2, 0], cameras.rotation[:, 2, 2]).sort().values
    gaps = torch.cat([azimuth[1:], azimuth[:1] + 2 * math.pi]) - azimuth
    assert gaps.max() == pytest.approx(math.pi / 4, abs=1e-4)


def test_a_steps_randomness_depends_on_seed_and_step_alone():
    def draw(seed, step):
        return views.sample_global(ViewsConfig(), views.step_generator(seed, step)).rotation

    assert torch.equal(draw(3, 7), draw(3, 7))
    assert not torch.equal(draw(3, 7), draw(3, 8))
    assert not torch.equal(draw(3, 7), draw(4, 7))


def test_an_image_crop_shows_its_window():
    """Rows go down and NDC's y goes up; a mix-up would show another window."""
    image = torch.zeros(1, 100, 100, 1)
    image[0, 10:20, 60:70] = 1.0  # NDC x in 0.2..0.4, y in 0.6..0.8
    window = torch.tensor([[0.3, 0.7, 0.1]])
    cut = views.crop_images(image, window, torch.tensor([0]), 10)
    assert cut.mean() == pytest.approx(1.0)


@pytest.mark.parametrize(("crop", "side"), [("side", 0.1), ("area", math.sqrt(0.1))])
def test_windows_have_the_configured_size_and_stay_in_the_frame(crop, side):
    config = LocalViewsConfig(crop=crop, share=0.1, per_view=50)
    windows, view = views.crop_windows(config, 3, rng())
    assert windows[:, 2].tolist() == pytest.approx([side] * 150)
    assert (windows[:, :2].abs() + side <= 1 + 1e-6).all()
    assert view.bincount().tolist() == [50, 50, 50]


def test_homography_maps_the_corners():
    square = torch.tensor([[[-1.0, -1], [1, -1], [1, 1], [-1, 1]]])
    moved = square * torch.tensor([[[0.9, 0.7], [0.6, 0.8], [1.0, 0.5], [0.7, 0.7]]])
    matrix = views.homography(moved, square)
    mapped = torch.cat([moved[0], torch.ones(4, 1)], dim=1).double() @ matrix[0].T
    torch.testing.assert_close(mapped[:, :2] / mapped[:, 2:], square[0].double())


def test_random_perspective_fills_and_keeps_what_it_does_not_draw():
    config = ViewsConfig(perspective=0.5, perspective_probability=1.0)
    black = torch.zeros(4, 40, 40, 1)
    warped = views.random_perspective(config, black, 1.0, rng())
    assert warped[:, 0, 0].max() > 0.5  # corners were drawn inwards: white came in
    assert warped[:, 20, 20].max() < 1e-4
    config.perspective_probability = 0.0
    torch.testing.assert_close(
        views.random_perspective(config, torch.rand(2, 8, 8, 1, generator=rng()), 1.0, rng()),
        torch.rand(2, 8, 8, 1, generator=rng()),
    )
