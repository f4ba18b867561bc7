"""Checks of rollouts pass the stored trajectory and what follows it, and catch what is planted into it, by name."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from systems import periodic_scene

from cconv.data.trajectory import ParticleType, Trajectory
from cconv.evaluation.checks import CHECKS
from cconv.evaluation.checks.rolled import SeriesCheck, make_rollout_material
from cconv.evaluation.checks.stability import measure_stability
from cconv.tasks import TASKS, task_named
from cconv.tasks.task import StepTask

SIDE, FRAMES = 16, 22
SCENE = periodic_scene(SIDE)
DX = SCENE.particle_spacing
STEPS = [name for name, task in TASKS.items() if issubclass(task, StepTask)]
PAIRS = [(task, check) for task in STEPS for check in TASKS[task].checks]
pairs = pytest.mark.parametrize(("task", "check"), PAIRS)


def vortices():
    """A lattice that moves with decaying vortices, twice as long as what is stored of it, (2 T + 4, N, 2)."""
    ticks = (torch.arange(SIDE, dtype=torch.float64) + 0.5) / SIDE
    positions, frames = torch.cartesian_prod(ticks, ticks), []
    for frame in range(2 * FRAMES + 4):
        frames.append(positions)
        x, y = (2 * math.pi * positions).unbind(dim=1)
        velocity = torch.stack([-x.cos() * y.sin(), x.sin() * y.cos()], dim=1)
        positions = positions + 0.02 * DX * math.exp(-0.04 * frame) * velocity
    return SCENE.box.wrap(torch.stack(frames))


def basin():
    """Fluid that sways above two rows of wall particles, (2 T + 4, N, 2), and the types of the particles."""
    positions = vortices()[0]
    walls = positions[:, 1] < 2 * DX
    sway = torch.sin(0.3 * torch.arange(2 * FRAMES + 4, dtype=torch.float64))
    away = (positions[:, 1] - 2 * DX).clamp(min=0) * ~walls
    shift = torch.stack([0.01 * away, torch.zeros_like(away)], dim=1)
    types = torch.where(walls, int(ParticleType.SOLID_WALL), int(ParticleType.FLUID))
    return positions + sway[:, None, None] * shift, types


class Replay:
    """Answers what leads to the stored frames and those after them, displaced by a planted fault.

    A start that is mapped is answered with the mapped frames. What lies beside the path goes on beside it, at a
    distance that grows by a factor in every frame.
    """

    def __init__(self, material, path, fault, growth=1.0):
        self.task, self._path, self._fault, self._growth = material.task, path, fault, growth
        self._mappings = {each.window.trajectory: each.mapping for each in material.others}

    def predict_frame(self, window, scene):
        now, following = (self._at(frame, window) for frame in (window.frame, window.frame + 1))
        wanted = following + self._growth * scene.box.displacement(window.present, now)
        step = scene.box.displacement(wanted, window.present)
        return (step - window.last_displacements(scene.box))[window.is_fluid]

    def _at(self, frame, window):
        mapping = self._mappings.get(window.trajectory, lambda points: points)
        return mapping(self._path[frame]) + self._fault(self._path, frame)


def material_of(task, path, types, scene):
    """Rollouts from the beginning of a path, of which the first half is stored."""
    stored = Trajectory(
        name="0",
        first_frame=0,
        positions=path[: FRAMES + 2].float(),
        velocities=torch.zeros_like(path[: FRAMES + 2]),
        masses=torch.full((SIDE**2,), DX**2),
        particle_types=types,
        boundary=None,
    )
    return make_rollout_material([stored], scene, task)


def none(path, frame):
    return 0.0


def checked(task, path, types, scene, fault=none, growth=1.0):
    """Findings of all checks of the task by (check, label), for a replay with a fault."""
    task = task_named(task, history=3)
    material = material_of(task, path, types, scene)
    model = Replay(material, path, fault, growth)
    return {
        (name, finding.label): finding for name in task.checks for finding in CHECKS[name](material).findings(model)
    }


@cache
def in_vortices(task, fault=none, growth=1.0):
    return checked(task, vortices(), torch.zeros(SIDE**2, dtype=torch.int64), SCENE, fault, growth)


@cache
def in_basin(task, fault=none):
    return checked(task, *basin(), replace(SCENE, box=type(SCENE.box)([0, 0], [1, 1], (True, False))), fault)


def amplified(task, fault=none):
    return in_vortices(task, fault, growth=1.3)


def breaks(path, frame):
    return math.nan if frame > 9 else 0.0


def heats(path, frame):
    noise = torch.randn(path[0].shape, generator=torch.Generator().manual_seed(frame), dtype=torch.float64)
    return 0.1 * DX * noise


def stands(path, frame):
    return SCENE.box.displacement(path[3], path[frame])


def drifts(path, frame):
    return torch.tensor([0.02 * DX * frame, 0.0], dtype=torch.float64)


def kicks(path, frame):
    return torch.where(torch.arange(len(path[0])) == 100, 3 * DX * (frame == 12), 0.0)[:, None]


def within(path, radius):
    """Where particles are relative to the centre, 0 outside a radius."""
    apart = path[5] - torch.tensor([0.5, 0.6], dtype=torch.float64)
    return torch.where(apart.norm(dim=1, keepdim=True) < radius, apart, 0.0)


def compresses(path, frame):
    return -0.3 * within(path, 0.3) * (frame > 6)


def empties(path, frame):
    return 0.7 * within(path, 0.2) * (frame > 6)


def pairs_up(path, frame):
    neighbors = SCENE.box.displacement(path[frame].roll(-1, 0), path[frame])
    return torch.where((torch.arange(len(path[0])) % SIDE == 4)[:, None], 0.8 * neighbors, 0.0) * (frame > 6)


def sinks(path, frame):
    return torch.tensor([0.0, -0.1 * DX * max(0, frame - 6)], dtype=torch.float64)


def is_lost_in_the_end(path, frame):
    return torch.tensor([0.1 * DX * max(0, frame - 10), 0.0], dtype=torch.float64)


def goes_one_way(path, frame):
    return torch.tensor([0.05 * DX * frame, 0.0], dtype=torch.float64)


FAULTS = {
    "breaks": (in_vortices, breaks, "completion", "as long as stored"),
    "heats": (in_vortices, heats, "motion", "energy too high"),
    "stands still": (in_vortices, stands, "motion", "energy too low"),
    "drifts": (in_vortices, drifts, "motion", "momentum drift"),
    "kicks one particle": (in_vortices, kicks, "motion", "largest displacement"),
    "compresses": (in_vortices, compresses, "packing", "too dense"),
    "empties a disc": (in_vortices, empties, "packing", "too sparse"),
    "pairs up": (in_vortices, pairs_up, "packing", "clumped"),
    "sinks into the wall": (in_basin, sinks, "packing", "in walls"),
    "amplifies disorder": (amplified, none, "perturbed_starts", "distance once shaken"),
    "heats disorder": (amplified, none, "perturbed_starts", "energy once shaken"),
    "amplifies a clump": (amplified, none, "perturbed_starts", "distance once squeezed"),
    "heats a clump": (amplified, none, "perturbed_starts", "energy once squeezed"),
    "has a length of its own": (in_vortices, goes_one_way, "mapped_starts", "scaled"),
    "knows left from right": (in_vortices, goes_one_way, "mapped_starts", "mirrored"),
    "knows directions": (in_vortices, goes_one_way, "mapped_starts", "turned"),
    "is lost in the end": (in_vortices, is_lost_in_the_end, "later_start", "later"),
}


@pytest.mark.parametrize("flow", [in_vortices, in_basin])
@pytest.mark.parametrize("task", STEPS)
def test_the_stored_trajectory_and_what_follows_it_pass_every_check(task, flow):
    findings = flow(task)
    assert [each for each in findings.values() if not each.passes] == []
    assert {check for check, _ in findings} == set(TASKS[task].checks)


@pytest.mark.parametrize("task", STEPS)
@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_caught_by_its_check(name, task):
    flow, fault, check, label = FAULTS[name]
    finding = flow(task, fault)[check, label]
    assert not finding.passes
    assert "frame" in finding.detail
    assert finding.label in CHECKS[check].failure.format(**vars(finding))


@pairs
def test_every_label_of_every_check_has_a_planted_fault(task, check):
    labels = {label for flow in (in_vortices, in_basin) for found, label in flow(task) if found == check}
    planted = {label for _, _, named, label in FAULTS.values() if named == check}
    assert labels - planted <= {"twice as long"}  # found by the same rollouts as its half


@pytest.mark.parametrize("task", STEPS)
def test_a_rollout_that_comes_to_its_stored_length_alone_is_told_apart(task):
    findings = in_vortices(task, lambda path, frame: math.nan if frame > FRAMES + 4 else 0.0)
    assert findings["completion", "as long as stored"].passes
    assert not findings["completion", "twice as long"].passes


@pytest.mark.parametrize("fault", [heats, drifts, kicks, compresses, pairs_up])
@pytest.mark.parametrize("task", STEPS)
def test_the_first_frame_beyond_a_limit_is_that_of_the_finding(task, fault):
    path, asked = vortices(), task_named(task, history=3)
    material = material_of(asked, path, torch.zeros(SIDE**2, dtype=torch.int64), SCENE)
    model = Replay(material, path, fault)
    (rolled,) = material.rolled(model)
    checks = [check for name in asked.checks if isinstance(check := CHECKS[name](material), SeriesCheck)]
    beyond = [check.first_beyond(rolled.positions, rolled.start) for check in checks]
    failed = {each.label: each.detail for check in checks for each in check.findings(model) if not each.passes}
    assert failed
    assert failed == {
        label: f"first beyond the limit at frame {frame} after the start"
        for each in beyond
        for label, frame in each.items()
    }


@pytest.mark.parametrize("task", STEPS)
def test_the_verdict_names_what_failed_and_when(task):
    path = vortices()
    asked = task_named(task, history=3)
    material = material_of(asked, path, torch.zeros(SIDE**2, dtype=torch.int64), SCENE)
    checks = [CHECKS[name](material) for name in asked.checks]
    found = measure_stability({"it": Replay(material, path, heats)}, checks, material.counts)
    assert not found["stable"]
    assert any("energy too high" in line and "at frame" in line for line in found["failures"])
    assert found["counts"] == {"seeds": 1, "plain_frames": 1 + 6, "stressed_frames": 0}


@pytest.mark.parametrize("task", STEPS)
def test_amplified_disorder_is_told_from_a_flow_that_is_wrong_anyway(task):
    findings = amplified(task)
    assert {check for (check, _), finding in findings.items() if not finding.passes} == {"perturbed_starts"}


@pytest.mark.parametrize("task", STEPS)
def test_all_seeds_are_rolled_out_once(task):
    asked = task_named(task, history=3)
    material = material_of(asked, vortices(), torch.zeros(SIDE**2, dtype=torch.int64), SCENE)
    checks, asked_for = [CHECKS[name](material) for name in asked.checks], []

    class Counted(Replay):
        def predict_frame(self, window, scene):
            asked_for.append((id(self), window.trajectory, window.frame))
            return super().predict_frame(window, scene)

    seeds = {name: Counted(material, vortices(), none) for name in ("first", "second")}
    measure_stability(seeds, checks, material.counts)
    assert len(asked_for) == len(set(asked_for)) > 0


@pytest.mark.parametrize("task", STEPS)
def test_in_fluid_with_a_surface_what_no_stored_frame_shows_is_not_compared(task):
    def falls_apart(path, frame):
        return heats(path, frame) * (frame > FRAMES + 1)

    closed, open_above = in_vortices(task, falls_apart), in_basin(task, falls_apart)
    assert not closed["motion", "energy too high"].passes
    assert all(finding.passes for (check, _), finding in open_above.items() if check in ("motion", "packing"))
    assert not in_basin(task, heats)["motion", "energy too high"].passes
