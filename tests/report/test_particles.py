from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.animation import FFMpegWriter
from matplotlib.collections import EllipseCollection
from particle_files import write_parts
from PIL import Image
from systems import periodic_scene, periodic_trajectory

from cconv.data.dataset import open_dataset
from cconv.data.quantities import speed
from cconv.errors import ConfigError
from cconv.report.particles import COLORINGS, PICTURE_DPI, frames_chart, write_animation, write_picture

pytestmark = pytest.mark.integration


def discs(axes):
    (collection,) = (artist for artist in axes.collections if isinstance(artist, EllipseCollection))
    return collection


def panels(figure):
    return [axes for axes in figure.axes if axes.get_title().startswith("frame")]


def space(folder):
    """A trajectory in three dimensions with boundary points, and its scene."""
    write_parts(folder)
    dataset = open_dataset(folder, particle_spacing=0.1)
    return dataset.trajectory("train", 0), dataset.scene


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7])
def test_every_frame_has_a_panel_with_its_particles(generator, count):
    trajectory = periodic_trajectory(generator, count)
    shown = panels(frames_chart(trajectory, periodic_scene(), range(count)))
    assert [axes.get_title() for axes in shown] == [f"frame {k}, t = {0.01 * k:.4g}" for k in range(count)]
    for axes, frame in zip(shown, trajectory, strict=True):
        assert np.array_equal(discs(axes).get_offsets(), frame.positions)


def test_discs_cover_the_area_of_their_fluid(generator):
    scene = periodic_scene()
    (axes,) = panels(frames_chart(periodic_trajectory(generator), scene, [0]))
    width, height = discs(axes).get_widths(), discs(axes).get_heights()
    assert np.pi / 4 * width * height == pytest.approx(scene.particle_spacing**2)
    assert axes.get_aspect() == 1
    assert (*axes.get_xlim(), *axes.get_ylim()) == (0, 1, 0, 1)


def test_equal_speeds_have_equal_colors_in_all_panels(generator):
    trajectory = periodic_trajectory(generator, 2)
    trajectory.velocities[1] = trajectory.velocities[0].flip(0)
    first, second = panels(frames_chart(trajectory, periodic_scene(), [0, 1]))
    colors = discs(first).get_facecolor()
    assert np.array_equal(colors, discs(second).get_facecolor()[::-1])
    assert len(np.unique(colors, axis=0)) > 30
    slowest = int(speed(trajectory[0]).argmin())
    assert colors[slowest].sum() == pytest.approx(colors.sum(axis=1).min(), rel=0.1)


def test_walls_are_grey_unless_the_type_is_shown(generator):
    trajectory = replace(periodic_trajectory(generator), particle_types=torch.arange(64) % 3)
    for color, greys in (("speed", 2), ("density", 2), ("type", 1)):
        (axes,) = panels(frames_chart(trajectory, periodic_scene(), [0], color))
        rgb = discs(axes).get_facecolor()[:3, :3]
        assert (np.ptp(rgb, axis=1) == 0).sum() == greys


def test_density_scale_is_centred_on_rest(generator):
    figure = frames_chart(periodic_trajectory(generator), periodic_scene(), [0, 1], "density")
    low, high = figure.axes[-1].get_ylim()
    assert low == -high
    assert figure.axes[-1].get_ylabel() == "density deviation [%]"


def test_legend_names_the_types_that_are_there(generator):
    trajectory = replace(periodic_trajectory(generator), particle_types=torch.arange(64) % 2 * 3)
    (legend,) = frames_chart(trajectory, periodic_scene(), [0], "type").legends
    assert [text.get_text() for text in legend.get_texts()] == ["fluid", "rigid"]


def test_fluid_at_rest_and_only_walls_can_be_drawn(generator):
    at_rest = periodic_trajectory(generator)
    at_rest.velocities.zero_()
    walls = replace(at_rest, particle_types=torch.ones(64, dtype=torch.int64))
    for trajectory in (at_rest, walls):
        for color in COLORINGS:
            assert panels(frames_chart(trajectory, periodic_scene(), [0, 1], color))


@pytest.mark.parametrize("color", COLORINGS)
def test_space_is_drawn_with_y_upwards_and_without_boundary_points(tmp_path, color):
    trajectory, scene = space(tmp_path / "a")
    shown = panels(frames_chart(trajectory, scene, [0, 1], color))
    for axes in shown:
        (particles,) = axes.collections
        assert len(particles.get_offsets()) == trajectory.positions.shape[1]
        assert axes._vertical_axis == 1


def test_markers_in_space_have_the_volume_of_their_fluid(tmp_path):
    """Two particles one spacing apart in the plane of view: markers reach over the gap by the factor (6/π)^(1/3)."""
    trajectory, scene = space(tmp_path / "a")
    (axes,) = panels(frames_chart(trajectory, scene, [0]))
    diameter = np.sqrt(axes.collections[0].get_sizes()[0])
    axes.view_init(elev=0, azim=-90, vertical_axis="z")
    axes.set_box_aspect(scene.box.lengths)
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    ends = np.array([[0.5, 0.5, 0.5], [0.5 + scene.particle_spacing, 0.5, 0.5]])
    x, y, _ = proj_transform(*ends.T, axes.get_proj())
    apart = np.linalg.norm(np.diff(axes.transData.transform(np.stack([x, y], axis=1)), axis=0))
    assert diameter == pytest.approx((6 / np.pi) ** (1 / 3) * apart * 72 / axes.figure.dpi, rel=1e-3)


def test_picture_has_the_size_of_its_figure(tmp_path, generator):
    figure = frames_chart(periodic_trajectory(generator), periodic_scene(), range(3))
    write_picture(figure, tmp_path / "new" / "a.png")
    with Image.open(tmp_path / "new" / "a.png") as image:
        assert image.format == "PNG"
        assert image.size == tuple(int(inches * PICTURE_DPI) for inches in figure.get_size_inches())
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a.png"]


def test_animation_has_a_picture_a_frame(tmp_path, generator):
    trajectory = periodic_trajectory(generator, 4)
    write_animation(tmp_path / "a.gif", trajectory, periodic_scene(), [0, 1, 3])
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 3
        assert image.info["duration"] == 50
        pictures = []
        for k in range(3):
            image.seek(k)
            pictures.append(np.array(image.convert("RGB")))
    assert not np.array_equal(pictures[0], pictures[1])
    assert [file.name for file in tmp_path.iterdir()] == ["a.gif"]


def test_interrupted_animation_leaves_nothing(tmp_path, generator):
    def stops(frames, label):
        yield from frames if label == "speed" else [0]
        if label != "speed":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_animation(tmp_path / "a.gif", periodic_trajectory(generator), periodic_scene(), range(3), progress=stops)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not FFMpegWriter.isAvailable(), reason="needs ffmpeg")
def test_animation_can_be_mp4(tmp_path, generator):
    write_animation(tmp_path / "a.mp4", periodic_trajectory(generator), periodic_scene(), range(3))
    assert b"ftyp" in (tmp_path / "a.mp4").read_bytes()[:16]


def test_missing_ffmpeg_and_unknown_suffixes_are_said(tmp_path, generator, monkeypatch):
    trajectory, scene = periodic_trajectory(generator), periodic_scene()
    monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: False)
    with pytest.raises(ConfigError, match="ffmpeg.*name a .gif"):
        write_animation(tmp_path / "a.mp4", trajectory, scene, range(3))
    with pytest.raises(ConfigError, match=".gif or .mp4"):
        write_animation(tmp_path / "a.avi", trajectory, scene, range(3))
    with pytest.raises(ConfigError, match="ends in .png"):
        write_picture(frames_chart(trajectory, scene, [0]), tmp_path / "a.jpg")
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_drawn_is_refused(generator):
    trajectory, scene = periodic_trajectory(generator), periodic_scene()
    with pytest.raises(ConfigError, match="Did you mean 'speed'"):
        frames_chart(trajectory, scene, [0], "sped")
    for frames in ([3], [-1], []):
        with pytest.raises(ConfigError, match="from 0 to 2"):
            frames_chart(trajectory, scene, frames)
    with pytest.raises(ConfigError, match="2 or 3 dimensions"):
        frames_chart(trajectory, replace(scene, dim=1), [0], "type")
