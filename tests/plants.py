"""Errors in the physics, each as a change of one source line, and the validation cases that should see it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Plant:
    """In a source file one text in place of another.

    Attributes:
        cases: the cheapest that should see it.
        missed: why none of them does; "" where one does.
    """

    file: str
    right: str
    wrong: str
    cases: tuple[str, ...]
    missed: str = ""

    def __str__(self) -> str:
        return f"{self.file}: {self.wrong}"


def _of(file: str, *changes: tuple) -> tuple[Plant, ...]:
    """Return plants of one file: right, wrong, the names of cases, and why it is missed if it is."""
    return tuple(
        Plant(file, right, wrong, tuple(cases.split()), "".join(missed)) for right, wrong, cases, *missed in changes
    )


# The level `coarse` of one of the cases should see each of these.
PLANTS = (
    *_of(
        "solver/transfer/particle_step.py",
        (
            "(mass * grid.spacing) * C[c, a] - stress_scale * stress[c, a]",
            "(mass * grid.spacing) * C[c, a] + stress_scale * stress[c, a]",
            "bar_fixed_fixed",
        ),
        (
            "stress_scale = kick * volume * grid.gradient_scale",
            "stress_scale = kick * volume * grid.spacing",
            "bar_fixed_fixed",
        ),
        # The factor of the cubic kernel is 3.
        (
            "stress_scale = kick * volume * grid.gradient_scale",
            "stress_scale = kick * volume * (3 * grid.inverse_spacing)",
            "bar_fixed_fixed",
        ),
        (
            "(distance[a] - 1.0)) * grid.gradient_scale",
            "(distance[a] - 1.0)) * (3 * grid.inverse_spacing)",
            "bar_fixed_fixed",
        ),
        ("sums.velocity, sums.moment).transpose()", "sums.velocity, sums.moment)", "homogeneous"),
        ("(mass * grid.spacing) * C[c, a] -", "(mass * grid.spacing) * C[a, c] -", "conservation taylor_green"),
        ("(mass * grid.spacing) * C[c, a] -", "(0.5 * mass * grid.spacing) * C[c, a] -", "dam_break"),
        ("rate = dt * C[i, k]", "rate = 0.5 * dt * C[i, k]", "bar_fixed_fixed"),
    ),
    *_of(
        "solver/transfer/splines.py", ("0.75 - (distance - 1.0) ** 2", "0.7 - (distance - 1.0) ** 2", "bar_fixed_fixed")
    ),
    *_of(
        "boundaries/mirror_images.py",
        ("result[c] *= signs[c]", "result[c] *= ti.max(signs[c], 0.0)", "bar_fixed_fixed"),
        ("result[c] *= signs[c]", "result[c] *= 1.0", "bar_fixed_fixed"),
    ),
    *_of(
        "solver/engine/device.py",
        ("step.kick * ti.cast", "-step.kick * ti.cast", "dam_break"),
        ("step.kick * ti.cast", "0.5 * step.kick * ti.cast", "dam_break"),
    ),
    *_of(
        "solver/transfer/particle_update.py",
        ("way = dt * v[c] + remainder[c]", "way = 0.5 * dt * v[c] + remainder[c]", "dam_break"),
    ),
    *_of(
        "solver/particles/state_bounds.py",
        (
            "growth = dt * (C.trace() + dt * second_invariant(C))",
            "growth = dt * (C[0, 0] + dt * second_invariant(C))",
            "dam_break",
        ),
        ("growth = dt * (C.trace() + dt * second_invariant(C))", "growth = dt * C.trace()", "elliptical_drop"),
    ),
    *_of(
        "solver/engine/step_size.py",
        ("due = run.kick_carry + 0.5 * (run.last_step + dt)", "due = dt", "column_dynamic mms_2d_neo_hookean"),
    ),
    *_of(
        "materials/fluid.py",
        (
            "spherical = constants[BULK_MODULUS] * (J - 1.0)",
            "spherical = 0.5 * constants[BULK_MODULUS] * (J - 1.0)",
            "hydrostatic",
        ),
        (
            "tau += constants[VISCOSITY] * (C + C.transpose())",
            "tau += 0.5 * constants[VISCOSITY] * (C + C.transpose())",
            "homogeneous",
        ),
        (
            "parameters.bulk_viscosity - 2 / 3 * parameters.viscosity",
            "parameters.bulk_viscosity + 2 / 3 * parameters.viscosity",
            "homogeneous",
        ),
        (
            "-exp_minus_1(-constants[EXPONENT] * log(crushed))",
            "-exp_minus_1((-constants[EXPONENT] - 1.0) * log(crushed))",
            "homogeneous",
        ),
    ),
    *_of(
        "materials/von_mises.py",
        ("stress = ti.static(math.sqrt(6.0)) * mu", "stress = ti.static(math.sqrt(4.0)) * mu", "homogeneous"),
    ),
    *_of(
        "materials/neo_hookean.py",
        (
            "constants[LAMBDA] * log(deformation.determinant())",
            "2.0 * constants[LAMBDA] * log(deformation.determinant())",
            "homogeneous",
        ),
    ),
    *_of(
        "materials/fixed_corotated.py",
        (
            "pressure_part = constants[LAMBDA] * (J - 1.0) * J",
            "pressure_part = constants[LAMBDA] * (J - 1.0) * J * J",
            "homogeneous",
        ),
        (
            "tau += constants[MU] * (stretched + stretched.transpose())",
            "tau += constants[MU] * stretched",
            "homogeneous",
        ),
    ),
    *_of(
        "materials/sand.py",
        ("phi = math.radians(parameters.friction_angle)", "phi = parameters.friction_angle", "sand_shear"),
        # The friction angle of triaxial compression.
        ("math.sqrt(2) * math.sin(phi)", "math.sqrt(2 / 3) * 4 * math.sin(phi) / (3 - math.sin(phi))", "sand_shear"),
        ("deviator *= strength / shear", "deviator *= 0.5 * strength / shear", "sand_shear"),
    ),
    *_of(
        "materials/snow.py",
        (
            "hardness = exp(constants[HARDENING] * (1.0 - variables[0]))",
            "hardness = exp(constants[HARDENING] * (variables[0] - 1.0))",
            "snow_oedometer",
        ),
        ("lost *= before / s[i]", "lost *= 1.0", "snow_oedometer"),
    ),
    *_of(
        "boundaries/rigid_bodies.py",
        (
            "self.momentum[b, a] = self.momentum[b, a] + self.colliders.loads.taken[row][a]",
            "self.momentum[b, a] = self.momentum[b, a] + (1.0 if a < 2 else 0.0) * self.colliders.loads.taken[row][a]",
            "floating_box",
        ),
        (
            "self.rate[b, a] = self.rate[b, a] + self.ways[b, a, k] * found",
            "self.rate[b, a] = self.rate[b, a] + 0.0 * self.ways[b, a, k] * found",
            "floating_box",
        ),
    ),
    *_of(
        "boundaries/loads.py",
        (
            "load[2] = arm[0] * impulse[1] - arm[1] * impulse[0]",
            "load[2] = arm[1] * impulse[0] - arm[0] * impulse[1]",
            "floating_box",
        ),
    ),
)

# Errors of about 5 %: a case should see them at its coarsest resolution.
SMALL_PLANTS = (
    *_of(
        "solver/transfer/particle_step.py",
        ("stress_scale = kick * volume", "stress_scale = 1.05 * kick * volume", "bar_fixed_fixed"),
        ("(mass * grid.spacing) * C[c, a] - stress", "(0.95 * mass * grid.spacing) * C[c, a] - stress", "taylor_green"),
        ("(distance[a] - 1.0)) * grid", "(distance[a] - 1.0)) * 1.05 * grid", "bar_fixed_fixed"),
        ("middle[d] = mass", "middle[d] = 1.05 * mass", "bar_fixed_fixed"),
        ("middle[kept + d] = mass", "middle[kept + d] = 1.05 * mass", "conservation_contact"),
        ("scale * (gained", "0.95 * scale * (gained", "conservation_contact"),
        ("0.5 * dt * (sheared", "0.475 * dt * (sheared", "conservation_contact"),
        ("rate = dt * C[i, k]", "rate = 1.05 * dt * C[i, k]", "bar_fixed_fixed"),
        ("new[i, j] += rate * H[k, j]", "new[i, j] += 0.95 * rate * H[k, j]", "sand_blocks"),
        ("v += kick * own.loads.push", "v += 1.05 * kick * own.loads.push", "mms_1d"),
        (
            "C += kick * own.loads.slope",
            "C += 0.95 * kick * own.loads.slope",
            "sand_blocks",
            "inside a body the nodes have the slope from the velocities of its particles; this one acts at its surface",
        ),
    ),
    *_of(
        "solver/transfer/splines.py",
        ("0.75 - (distance", "0.7875 - (distance", "bar_fixed_fixed"),
        ("0.5 * (1.5 - distance) ** 2", "0.525 * (1.5 - distance) ** 2", "bar_fixed_fixed"),
    ),
    *_of("solver/transfer/volume.py", ("exp(missing * ti", "exp(0.95 * missing * ti", "cook")),
    *_of("stability/transfer_factors.py", ('"quadratic": 4', '"quadratic": 4.2', "bar_fixed_fixed")),
    *_of(
        "solver/transfer/node_update.py",
        ("value[a] / value[d] + pull[a]", "value[a] / value[d] + 1.05 * pull[a]", "take_off"),
    ),
    *_of(
        "solver/transfer/particle_update.py",
        ("way = dt * v[c] + remainder[c]", "way = 1.05 * dt * v[c] + remainder[c]", "take_off"),
    ),
    *_of(
        "materials/fluid.py",
        (
            "opened = J_minus_1 + (growth + growth * J_minus_1)",
            "opened = J_minus_1 + (growth + 0.95 * growth * J_minus_1)",
            "fluid_blocks",
        ),
        ("spherical = constants[BULK_MODULUS] * (J", "spherical = 1.05 * constants[BULK_MODULUS] * (J", "hydrostatic"),
        ("constants[BULK_MODULUS] * crushed", "1.05 * constants[BULK_MODULUS] * crushed", "homogeneous"),
        ("-constants[EXPONENT] * log(crushed)", "-1.05 * constants[EXPONENT] * log(crushed)", "homogeneous"),
        ("tau += constants[VISCOSITY]", "tau += 1.05 * constants[VISCOSITY]", "poiseuille"),
        ("parameters.bulk_viscosity - 2 / 3", "parameters.bulk_viscosity - 0.7", "fluid_blocks"),
        ("parameters.bulk_viscosity - 2 / 3", "1.05 * parameters.bulk_viscosity - 2 / 3", "fluid_blocks"),
        (
            "1.0 if parameters.tension_cutoff else LARGEST",
            "1.05 if parameters.tension_cutoff else LARGEST",
            "fluid_blocks",
        ),
    ),
    *_of(
        "solver/particles/state_bounds.py",
        ("dt * (C.trace() +", "dt * (1.05 * C.trace() +", "hydrostatic_drop"),
        ("dt * second_invariant(C))", "dt * 0.95 * second_invariant(C))", "elliptical_drop"),
    ),
    *_of("solver/engine/device.py", ("step.kick * ti.cast", "1.05 * step.kick * ti.cast", "take_off")),
    *_of(
        "solver/drive/forces.py",
        ("result[a] = kick * self.values", "result[a] = 1.05 * kick * self.values", "column_static"),
    ),
    *_of(
        "solver/engine/step_size.py",
        ("0.5 * (run.last_step + dt)", "0.525 * (run.last_step + dt)", "take_off"),
        ("run.time + dt\n", "run.time + 1.05 * dt\n", "bar_fixed_fixed"),
    ),
    *_of(
        "scene/sampling.py",
        ("mass = body.material.density * volume", "mass = 1.05 * body.material.density * volume", "bar_fixed_fixed"),
        ("volume = rest_volume(", "volume = 1.05 * rest_volume(", "conservation"),
        ("body.material.density * (position", "1.05 * body.material.density * (position", "hydrostatic"),
        ("_offset(body, position) @ affine.T", "1.05 * _offset(body, position) @ affine.T", "metal_blocks"),
    ),
    *_of(
        "boundaries/mirror_images.py",
        ("bound = coefficient * (", "bound = 1.05 * coefficient * (", "sliding_block"),
        ("result[c] *= signs[c]", "result[c] *= ti.max(signs[c], -0.95)", "bar_fixed_fixed"),
        (
            "result[c] = -result[c]",
            "result[c] = -0.95 * result[c]",
            "poiseuille bingham",
            "the node on the wall is stopped as well, so that images are a hundredth of the error of the grid",
        ),
        ("ti.cast(outward >= 0, int)", "ti.cast(outward > -1e30, int)", "take_off"),
    ),
    *_of("boundaries/walls.py", ("mass * self.velocity_at(", "1.05 * mass * self.velocity_at(", "couette")),
    *_of(
        "solver/contact/body_contact.py",
        ("rub = ti.min(friction * push", "rub = ti.min(1.05 * friction * push", "slope_contact"),
        ("along = u + aside", "along = u + 0.0 * aside", "rolling_contact"),
    ),
    *_of(
        "solver/contact/surfaces.py",
        ("way[c] += self.surface[g][p][d + c]", "way[c] += 0.0 * self.surface[g][p][d + c]", "two_disks_contact"),
    ),
    *_of(
        "materials/elasticity.py",
        ("youngs_modulus / (2 *", "youngs_modulus / (2.1 *", "bar_fixed_fixed"),
        ("(1 - 2 * nu))", "(1 - 2.1 * nu))", "mms_2d_neo_hookean homogeneous"),
        ("strains[i] = log(", "strains[i] = 1.05 * log(", "column_hencky"),
    ),
    *_of(
        "materials/neo_hookean.py",
        ("constants[MU] * (left", "1.05 * constants[MU] * (left", "mms_1d"),
        ("= constants[LAMBDA] * log(", "= 1.05 * constants[LAMBDA] * log(", "mms_2d_neo_hookean homogeneous"),
        ("identity = ti.Matrix.identity(float, C.n)", "identity = 1.05 * ti.Matrix.identity(float, C.n)", "mms_1d"),
    ),
    *_of(
        "materials/fixed_corotated.py",
        ("tau += constants[MU] * (", "tau += 1.05 * constants[MU] * (", "bar_fixed_fixed"),
        (
            "= constants[LAMBDA] * (J - 1.0) * J",
            "= 1.05 * constants[LAMBDA] * (J - 1.0) * J",
            "mms_2d_corotated homogeneous",
        ),
        ("constants[LAMBDA] * (J - 1.0) * J", "constants[LAMBDA] * (J - 1.0)", "mms_2d_corotated homogeneous"),
    ),
    *_of(
        "materials/viscoplastic.py",
        ("over = q - constants[YIELD_STRESS]", "over = q - 1.05 * constants[YIELD_STRESS]", "paste_blocks"),
        ("share = (constants[YIELD_STRESS] +", "share = (1.05 * constants[YIELD_STRESS] +", "paste_blocks"),
        ("modulus_time / constants", "1.05 * modulus_time / constants", "paste_blocks"),
        ("identity(float, F.n) + constants[SHEAR", "identity(float, F.n) + 1.05 * constants[SHEAR", "paste_blocks"),
        ("= constants[BULK_MODULUS] * (J - 1.0)", "= 1.05 * constants[BULK_MODULUS] * (J - 1.0)", "paste_blocks"),
    ),
    *_of("solver/frames/columns.py", ("(-3 * ratios)", "(-3.15 * ratios)", "hydrostatic")),
    *_of(
        "materials/von_mises.py",
        ("math.sqrt(6.0)) * mu", "math.sqrt(6.6)) * mu", "metal_blocks"),
        ("(constants[YIELD_STRESS] +", "(1.05 * constants[YIELD_STRESS] +", "metal_blocks"),
        ("constants[HARDENING_MODULUS] * variables", "1.05 * constants[HARDENING_MODULUS] * variables", "metal_blocks"),
        ("(3.0 * mu + constants", "(3.15 * mu + constants", "metal_blocks"),
        ("1.0 - 3.0 * mu * flow", "1.0 - 3.15 * mu * flow", "metal_blocks"),
        ("constants[LAMBDA] * volume", "1.05 * constants[LAMBDA] * volume", "metal_blocks"),
        ("variables[1] = e[2]", "variables[1] = 0.95 * e[2]", "metal_blocks"),
        ("e[2] = in_frame[2]", "e[2] = 1.05 * in_frame[2]", "metal_blocks_3d"),
    ),
    *_of(
        "materials/sand.py",
        ("math.radians(parameters", "math.radians(1.05 * parameters", "sand_shear"),
        ("parameters.cohesion / (math", "1.05 * parameters.cohesion / (math", "sand_blocks"),
        ("math.sqrt(2) * math.sin", "1.05 * math.sqrt(2) * math.sin", "sand_shear"),
        ("float(parameters.volume_correction)", "0.0", "sand_blocks"),
        ("constants[CORRECTION] * v[0]", "0.95 * constants[CORRECTION] * v[0]", "sand_blocks"),
        ("ti.max(volume - constants[TIP], 0.0)", "0.95 * ti.max(volume - constants[TIP], 0.0)", "sand_blocks"),
        ("deviator *= strength", "deviator *= 1.05 * strength", "sand_shear"),
        ("spherical = constants[LAMBDA]", "spherical = 1.05 * constants[LAMBDA]", "sand_shear"),
        ("log(J), log(seen)", "log(J), log(1.05 * seen)", "sand_toss"),
        ("v[0] + share * opening", "v[0] + 0.0 * share * opening", "sand_toss"),
    ),
    *_of(
        "materials/snow.py",
        (
            "            1 - parameters.critical_compression,",
            "1 - 1.05 * parameters.critical_compression,",
            "snow_blocks",
        ),
        ("            1 + parameters.critical_stretch,", "1 + 1.05 * parameters.critical_stretch,", "snow_blocks"),
        ("hardness = exp(constants", "hardness = exp(1.05 * constants", "snow_blocks"),
        ("2.0 * hardness * constants[MU]", "2.1 * hardness * constants[MU]", "snow_blocks"),
        ("= hardness * constants[LAMBDA]", "= 1.05 * hardness * constants[LAMBDA]", "snow_blocks"),
        ("(variables[0] * lost,", "(variables[0] * lost**0.95,", "snow_blocks"),
    ),
)
