"""Compiled sums over neighbours for the solver, on the rows from `first` up to `last`, without Python's lock.

Positions and velocities have three components whatever the dimension of the scene. `lengths` are those of the box,
infinite along open axes. Neighbours lie in compressed rows that may reach beyond the kernel's support.
"""

import math

import numpy as np
from numba import njit

from cconv.compiled import compile_cached

_compile = compile_cached(nogil=True, fastmath={"contract"}, error_model="numpy")


@njit(inline="always", fastmath={"contract"}, error_model="numpy")
def look_up(table, place):
    """Value of a kernel's table at `place`, a distance counted in intervals, up to their number."""
    interval = np.uintp(place)
    t = place - interval
    return ((table[interval, 0] * t + table[interval, 1]) * t + table[interval, 2]) * t + table[interval, 3]


@njit(inline="always")
def _nearest_image(difference, length):
    if difference > 0.5 * length:
        return difference - length
    if difference < -0.5 * length:
        return difference + length
    return difference


@njit(inline="always")
def _displacement(positions, i, j, lengths):
    """Components of x_i - x_j, and its squared length."""
    dx = _nearest_image(positions[i, 0] - positions[j, 0], lengths[0])
    dy = _nearest_image(positions[i, 1] - positions[j, 1], lengths[1])
    dz = _nearest_image(positions[i, 2] - positions[j, 2], lengths[2])
    return dx, dy, dz, dx * dx + dy * dy + dz * dz


@_compile
def rows_of_pairs(pairs, is_wall):
    """Both directions of pairs (P, 2) in compressed rows: splits (N + 1,) and neighbours, ascending within a row.

    Pairs of two wall particles are left out. Two counting sorts: by neighbour first, then by row.
    """
    particles = len(is_wall)
    counts = np.zeros(particles + 1, np.int64)
    for first, second in pairs:
        if not (is_wall[first] and is_wall[second]):
            counts[first + 1] += 1
            counts[second + 1] += 1
    splits = np.cumsum(counts)
    rows_by_neighbor = np.empty(splits[-1], np.int32)
    neighbors = np.empty(splits[-1], np.int32)
    places = splits[:-1].copy()
    for first, second in pairs:
        if not (is_wall[first] and is_wall[second]):
            rows_by_neighbor[places[first]] = second
            rows_by_neighbor[places[second]] = first
            places[first] += 1
            places[second] += 1
    places = splits[:-1].copy()
    for neighbor in range(particles):
        for place in range(splits[neighbor], splits[neighbor + 1]):
            row = rows_by_neighbor[place]
            neighbors[places[row]] = neighbor
            places[row] += 1
    return splits, neighbors


@_compile
def moved_further(positions, before, lengths, distance):
    """Whether a particle lies further than `distance` from where it was."""
    for i in range(len(positions)):
        squared = 0.0
        for axis in range(3):
            squared += _nearest_image(positions[i, axis] - before[i, axis], lengths[axis]) ** 2
        if not squared <= distance * distance:
            return True
    return False


@_compile
def move(positions, velocities, time_step, lower, lengths, moved):
    """Set `moved` to the positions one step later, brought back into the box along periodic axes."""
    for i in range(len(positions)):
        for axis in range(3):
            x = positions[i, axis] + time_step * velocities[i, axis]
            length = lengths[axis]
            if length < math.inf:
                x -= length * math.floor((x - lower[axis]) / length)
                if x >= lower[axis] + length:  # by rounding
                    x = lower[axis]
            moved[i, axis] = x


@_compile
def sum_densities(first, last, splits, neighbors, positions, lengths, masses, support, table, is_wall, densities):
    """Set the density of fluid particles to m_i Σ_j W_ij, themselves included (Adami et al. 2013)."""
    scale = (len(table) - 1) / support
    for i in range(first, last):
        if is_wall[i]:
            continue
        total = table[0, 3]
        for place in range(splits[i], splits[i + 1]):
            j = neighbors[place]
            _, _, _, squared = _displacement(positions, i, j, lengths)
            if squared < support * support:
                total += look_up(table, math.sqrt(squared) * scale)
        densities[i] = masses[i] * total


@_compile
def density_rates(
    first, last, splits, neighbors, positions, lengths, masses, support, slopes, is_wall, velocities, densities, rates
):
    """Set the rate of density of fluid particles, ρ_i Σ_j m_j/ρ_j (u_i - u_j)·∇W_ij (Adami et al. 2012, eq. 6)."""
    scale = (len(slopes) - 1) / support
    for i in range(first, last):
        if is_wall[i]:
            continue
        ux, uy, uz = velocities[i, 0], velocities[i, 1], velocities[i, 2]
        total = 0.0
        for place in range(splits[i], splits[i + 1]):
            j = neighbors[place]
            dx, dy, dz, squared = _displacement(positions, i, j, lengths)
            if 0 < squared < support * support:
                distance = math.sqrt(squared)
                approach = (ux - velocities[j, 0]) * dx + (uy - velocities[j, 1]) * dy + (uz - velocities[j, 2]) * dz
                total += masses[j] / densities[j] * approach * look_up(slopes, distance * scale) / distance
        rates[i] = densities[i] * total


@_compile
def shepard_densities(
    first, last, splits, neighbors, positions, lengths, masses, support, table, is_wall, densities, renormalized
):
    """Set Σ_j m_j W_ij / min(1, Σ_j m_j/ρ_j W_ij) for fluid particles (Zhang et al. 2017)."""
    scale = (len(table) - 1) / support
    for i in range(first, last):
        if is_wall[i]:
            continue
        mass, volume = masses[i] * table[0, 3], masses[i] / densities[i] * table[0, 3]
        for place in range(splits[i], splits[i + 1]):
            j = neighbors[place]
            _, _, _, squared = _displacement(positions, i, j, lengths)
            if squared < support * support:
                weight = masses[j] * look_up(table, math.sqrt(squared) * scale)
                mass += weight
                volume += weight / densities[j]
        renormalized[i] = mass / min(1.0, volume)


@_compile
def extrapolate_to_walls(
    first, last, splits, neighbors, positions, lengths, support, table, is_wall,
    force, densities, pressures, velocities, transport_velocities, wall_velocities, wall_transport,
):  # fmt: skip
    """Set pressure and velocities of wall particles from the fluid near them (Adami et al. 2012, eqs. 22, 23, 27).

    A wall particle without fluid near it gets pressure 0 and its own velocity.
    """
    scale = (len(table) - 1) / support
    for i in range(first, last):
        if not is_wall[i]:
            continue
        total = pressure = 0.0
        u = np.zeros(3)
        v = np.zeros(3)
        for place in range(splits[i], splits[i + 1]):
            j = neighbors[place]
            if is_wall[j]:
                continue
            dx, dy, dz, squared = _displacement(positions, i, j, lengths)
            if squared < support * support:
                weight = look_up(table, math.sqrt(squared) * scale)
                total += weight
                column = force[i, 0] * dx + force[i, 1] * dy + force[i, 2] * dz
                pressure += weight * (pressures[j] + densities[j] * column)
                for axis in range(3):
                    u[axis] += weight * velocities[j, axis]
                    v[axis] += weight * transport_velocities[j, axis]
        pressures[i] = pressure / total if total > 0 else 0.0
        for axis in range(3):
            own = velocities[i, axis]
            wall_velocities[i, axis] = 2 * own - u[axis] / total if total > 0 else own
            wall_transport[i, axis] = 2 * own - v[axis] / total if total > 0 else own


@_compile
def accelerations(
    first, last, splits, neighbors, positions, lengths, masses, support, slopes, is_wall,
    velocities, transport_velocities, densities, pressures, dynamic_viscosities,
    wall_friction, transport_pressure, artificial, core, accelerations, shifts,
):  # fmt: skip
    """Set accelerations of fluid particles by pressure and viscosity, and those by the transport pressure.

    Adami et al. 2013, eqs. 8 and 13, with the artificial viscosity of Adami et al. 2012, eq. 11, between fluid
    particles: `artificial` is α h c, `core` 0.01 h². Without `wall_friction` walls slip freely.
    """
    scale = (len(slopes) - 1) / support
    for i in range(first, last):
        if is_wall[i]:
            continue
        ux, uy, uz = velocities[i, 0], velocities[i, 1], velocities[i, 2]
        sx = transport_velocities[i, 0] - ux
        sy = transport_velocities[i, 1] - uy
        sz = transport_velocities[i, 2] - uz
        rho, pressure, viscosity, mass = densities[i], pressures[i], dynamic_viscosities[i], masses[i]
        volume = (mass / rho) ** 2
        ax = ay = az = bx = by = bz = 0.0
        for place in range(splits[i], splits[i + 1]):
            j = neighbors[place]
            dx, dy, dz, squared = _displacement(positions, i, j, lengths)
            if not 0 < squared < support * support:
                continue
            distance = math.sqrt(squared)
            slope = look_up(slopes, distance * scale) / distance
            vx, vy, vz = velocities[j, 0], velocities[j, 1], velocities[j, 2]
            rho_j = densities[j]
            prefactor = (volume + (masses[j] / rho_j) ** 2) / mass * slope
            mean_pressure = (rho_j * pressure + rho * pressures[j]) / (rho + rho_j)
            along = prefactor * -mean_pressure
            shift = prefactor * -transport_pressure
            ex, ey, ez = ux - vx, uy - vy, uz - vz
            if artificial > 0 and not is_wall[j]:
                closing = ex * dx + ey * dy + ez * dz
                along += masses[j] * artificial * closing * slope / (0.5 * (rho + rho_j) * (squared + core))
            friction = 0.0
            if wall_friction or not is_wall[j]:
                other = dynamic_viscosities[j]
                both = viscosity + other
                friction = prefactor * 2 * viscosity * other / both if both > 0 else 0.0
            # The stress A of the transport velocity, half of ρ u (v - u) of both, applied to the displacement.
            own = 0.5 * prefactor * rho * (sx * dx + sy * dy + sz * dz)
            near = (transport_velocities[j, 0] - vx) * dx + (transport_velocities[j, 1] - vy) * dy
            near = 0.5 * prefactor * rho_j * (near + (transport_velocities[j, 2] - vz) * dz)
            ax += along * dx + friction * ex + own * ux + near * vx
            ay += along * dy + friction * ey + own * uy + near * vy
            az += along * dz + friction * ez + own * uz + near * vz
            bx += shift * dx
            by += shift * dy
            bz += shift * dz
        accelerations[i, 0], accelerations[i, 1], accelerations[i, 2] = ax, ay, az
        shifts[i, 0], shifts[i, 1], shifts[i, 2] = bx, by, bz
