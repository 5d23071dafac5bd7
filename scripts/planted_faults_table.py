"""Sixty faults for ``scripts/planted_faults.py`` to plant: one wrong expression each, which a user could notice.

A fault is anchored by a function and an expression in it, so that it follows the code when that moves: the expression is
compared as a syntax tree, whatever its line breaks and parentheses, and must occur once in all functions of that name.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FAULTS", "Fault"]


@dataclass(frozen=True)
class Fault:
    """One wrong expression.

    Attributes:
        name: of the fault.
        room: file under ``torchpt/`` where the function stood last; a hint for readers.
        tests: folders of ``tests/``, divided by spaces: the first is that of the room, the others concern the fault too.
        function: qualified name of a function or class, such as ``Phong.eval_pdf``.
        before: the right expression.
        after: the wrong one.
        why: what a user would notice.
    """

    name: str
    room: str
    tests: str
    function: str
    before: str
    after: str
    why: str


FAULTS = (
    # -- math
    Fault(
        "cdf_lower_ends",
        "math/sampling.py",
        "math lights",
        "Distribution1D.of",
        "torch.cumsum(w, 0)",
        "torch.cumsum(w, 0) - w",
        "off by one in a CDF: each draw falls on the light after the one whose probability is used",
    ),
    Fault(
        "fresnel_without_p",
        "math/microfacet.py",
        "math bsdfs",
        "fresnel_dielectric",
        "0.5 * (s * s + p * p)",
        "s * s",
        "glass reflects as if all light were polarized across the plane of incidence: too much at middle angles",
    ),
    Fault(
        "bound_by_larger_alpha",
        "math/microfacet.py",
        "math bsdfs",
        "_bound",
        "torch.minimum(alpha_u, alpha_v)",
        "torch.maximum(alpha_u, alpha_v)",
        "anisotropic metals are too dark: normals that reflect above the surface are never drawn",
    ),
    Fault(
        "transforms_in_reverse",
        "math/transforms.py",
        "math format",
        "compose",
        "OPERATIONS[name](argument, f'{index}.{name}', device) @ total",
        "total @ OPERATIONS[name](argument, f'{index}.{name}', device)",
        "a shape that is turned and then moved is moved and then turned",
    ),
    # -- bsdfs
    Fault(
        "phong_without_cosine",
        "physics/bsdfs/kinds/phong.py",
        "bsdfs integrators",
        "Phong.eval_pdf",
        "(exponent + 2.0) * peak * cosine",
        "(exponent + 2.0) * peak * seen",
        "dropped cosine: highlights of Phong surfaces are too bright at grazing angles",
    ),
    Fault(
        "radiance_across_glass",
        "physics/bsdfs/lobes.py",
        "bsdfs integrators",
        "sample_smooth_interface",
        "weight_of_choice * side.eta_ti * side.eta_ti",
        "weight_of_choice * side.eta_it * side.eta_it",
        "eta the wrong way round: what is seen from within glass or water is too bright by the fourth power of its index",
    ),
    Fault(
        "frosted_density",
        "physics/bsdfs/kinds/roughdielectric.py",
        "bsdfs integrators",
        "RoughDielectric.eval_pdf",
        "(1.0 - r) * (eta_it * eta_it)",
        "(1.0 - r) / (eta_it * eta_it)",
        "eta the wrong way round in a density: frosted glass changes how much light it lets through",
    ),
    Fault(
        "blend_reuses_choice",
        "physics/bsdfs/kinds/blend.py",
        "bsdfs",
        "Blend.sample",
        "((lobe - low) / width).clamp(0.0, 1.0 - 2.0**-24)",
        "lobe",
        "a random number used twice: in blends of materials with several lobes the number that chose the material, no longer "
        "uniform, chooses the lobe",
    ),
    Fault(
        "energy_without_colour",
        "physics/bsdfs/kinds/roughconductor.py",
        "bsdfs",
        "RoughConductor.eval_pdf",
        "value * f0",
        "value",
        "rough gold with energy_compensation is too bright, as if light between its facets lost no colour",
    ),
    Fault(
        "plastic_from_outside",
        "physics/bsdfs/kinds/plastic.py",
        "bsdfs",
        "Plastic.prepare",
        "diffuse_transmittance(1.0 / eta)",
        "diffuse_transmittance(eta)",
        "eta the wrong way round: plastic is too dark, as if light left its coat from within as easily as it enters",
    ),
    # -- lights
    Fault(
        "environment_chance_of_first",
        "physics/lights/choice.py",
        "lights math",
        "environment",
        "distribution.pmf[-1]",
        "distribution.pmf[0]",
        "a scene with an environment and other lights: MIS weighs rays that escape by the chance of another light",
    ),
    Fault(
        "share_of_even_draws",
        "physics/lights/choice.py",
        "lights integrators",
        "_local_probability",
        "p * (1.0 - share)",
        "p",
        "scenes of 3 to 64 lamps are too dark: probabilities of lights sum to more than 1",
    ),
    Fault(
        "light_from_behind",
        "physics/lights/solid_angle.py",
        "lights integrators",
        "inverse_pdf",
        "angle * torch.sign(by_area)",
        "angle",
        "lamps that are near shine out of their backs",
    ),
    Fault(
        "near_light_has_no_gradient",
        "physics/lights/solid_angle.py",
        "lights render gradients",
        "inverse_pdf",
        "angle * torch.where(seen, by_area / torch.where(seen, value, 1.0), 0.0)",
        "angle * seen",
        "dropped term of a gradient: moving a lamp or what it lights near by changes nothing",
    ),
    Fault(
        "environment_turned_back",
        "physics/lights/kinds/envmap.py",
        "lights",
        "Envmap.row",
        "torch.linalg.inv(linear)",
        "linear",
        "the transform of an environment map turns it the wrong way",
    ),
    Fault(
        "environment_half_texel",
        "physics/lights/kinds/envmap.py",
        "lights integrators",
        "sample",
        "x + (column + 0.5)",
        "x + column",
        "light sampled from an environment map comes from half a texel beside where it is seen, and MIS adds up wrongly",
    ),
    Fault(
        "axes_turned_round",
        "physics/lights/tree.py",
        "lights",
        "build",
        "array(axis).T",
        "-array(axis).T",
        "many lights: the light tree believes that they shine away from where they do, and passes them over",
    ),
    # -- textures
    Fault(
        "bilinear_half_texel",
        "physics/textures/atlas.py",
        "textures integrators",
        "_corners",
        "u * columns - 0.5 * blend",
        "u * columns",
        "bilinear images lie half a texel beside where they belong, across but not along",
    ),
    Fault(
        "slope_by_wrong_axis",
        "physics/textures/atlas.py",
        "textures",
        "_slope",
        "along_u * c.transforms[1] + along_v * c.transforms[4]",
        "along_u * c.transforms[3] + along_v * c.transforms[4]",
        "bump maps whose uv_transform turns them are lit from the wrong side",
    ),
    Fault(
        "alpha_decoded",
        "physics/textures/kinds/image.py",
        "textures format",
        "_decoded",
        "values.shape[2] - (1 if values.shape[2] in (2, 4) else 0)",
        "values.shape[2]",
        "wrong colour space: the alpha of a PNG is decoded as sRGB, so that half opaque leaves let too much light pass",
    ),
    # -- cameras
    Fault(
        "pixel_aspect_upside",
        "physics/cameras/pinhole.py",
        "cameras",
        "Pinhole.slopes",
        "up / self.pixel_aspect",
        "up * self.pixel_aspect",
        "pictures of cameras whose pixels are no squares are stretched the wrong way",
    ),
    Fault(
        "opencv_place",
        "physics/cameras/opencv.py",
        "cameras",
        "pose",
        "-turn.T @ move",
        "-turn @ move",
        "a camera given by OpenCV's R and t stands in the wrong place as soon as it is turned",
    ),
    # -- samplers
    Fault(
        "same_numbers_at_each_depth",
        "physics/samplers/dimensions.py",
        "samplers integrators",
        "salt",
        "1 + (depth + step * VERTICES_OF_STEP) * DIMENSIONS_OF_VERTEX + int(dimension)",
        "1 + int(dimension)",
        "a random dimension used again: every vertex of a path draws the numbers of the one before, and pictures are wrong",
    ),
    Fault(
        "sampler_without_seed",
        "physics/samplers/base.py",
        "samplers",
        "Points.key",
        "mix(mix(pixel.to(torch.int32)) ^ seed)",
        "mix(mix(pixel.to(torch.int32)))",
        "an unseeded sampler: each seed gives the same picture, whose known error is 0",
    ),
    # -- film
    Fault(
        "mitchell_coefficient",
        "physics/film/kinds/mitchell.py",
        "film",
        "Mitchell.profile",
        "(6 * b + 30 * c) * x**2",
        "(6 * b + 24 * c) * x**2",
        "the Mitchell filter jumps at a pixel's distance: rings about edges",
    ),
    Fault(
        "variance_of_few",
        "physics/film/sums.py",
        "film render",
        "Film.variance",
        "len(filled) - 1",
        "len(filled)",
        "a statistic wrong: the layer `variance` and relMSE are too small, by half where there are two randomizations",
    ),
    Fault(
        "pilots_say_twice",
        "physics/film/error.py",
        "film render",
        "error_at",
        "(a - b).square() / 2",
        "(a - b).square()",
        "a statistic wrong: pictures say twice the error that they have, and target_error takes twice the samples",
    ),
    # -- integrators
    Fault(
        "roulette_without_weight",
        "paths/roulette.py",
        "integrators",
        "russian_roulette",
        "throughput / torch.where(alive, chance, 1.0)",
        "throughput",
        "deep indirect light is missing: what survives roulette does not stand for what did not",
    ),
    Fault(
        "emission_without_mis",
        "paths/vertex.py",
        "integrators lights",
        "_gathered",
        "throughput * radiance * weight",
        "throughput * radiance",
        "missing MIS weight: lamps that paths meet by chance count beside their own light samples",
    ),
    Fault(
        "opacity_reuses_number",
        "engines/tensors.py",
        "integrators",
        "TensorsEngine.transmit",
        "salts(paths.depth, in_transit.lanes.device, in_transit.step)",
        "salts(paths.depth, flight.lanes.device)",
        "a random dimension used again: a ray that passed one leaf passes all further ones of its opacity",
    ),
    Fault(
        "infinite_counted_twice",
        "paths/nonfinite.py",
        "integrators render",
        "NonFinite.of",
        "count - nans",
        "count",
        "counts wrong: samples that are NaN count as infinite too, so nonfinite_samples is too large",
    ),
    Fault(
        "position_in_lanes",
        "paths/layers.py",
        "integrators render",
        "Position.values",
        "seen.at.p + seen.centre.to(seen.dtype)[:, None]",
        "seen.at.p",
        "the layer `position` of a scene far from the origin is about its middle instead of the world's origin",
    ),
    # -- ibl
    Fault(
        "prefiltered_by_roughness",
        "physics/ibl/convolve.py",
        "ibl",
        "prefiltered",
        "_ggx_lobe(roughness * roughness, samples)",
        "_ggx_lobe(roughness, samples)",
        "the preview's mirrors are blurred too much: roughness is taken for alpha",
    ),
    # -- shapes
    Fault(
        "normals_move_like_points",
        "physics/shapes/primitives/triangle.py",
        "shapes scene meshes",
        "Triangle.corners",
        "torch.linalg.inv(linear).T @ given.T",
        "linear @ given.T",
        "meshes with normals of their own are shaded wrongly under a scale that is not the same in all directions",
    ),
    Fault(
        "measure_has_no_derivative",
        "physics/shapes/interaction.py",
        "shapes render gradients",
        "reattach",
        "torch.where(usable, measure / torch.where(usable, value, 1.0), 1.0)",
        "torch.ones_like(measure)",
        "dropped term of a gradient: indirect light does not know that surfaces which move apart see less of each other",
    ),
    Fault(
        "rays_leave_by_the_front",
        "physics/shapes/interaction.py",
        "shapes integrators",
        "offset_origin",
        "torch.copysign(step, dot(w, at.ng))",
        "step",
        "rays that go through a surface begin before it and meet it again: glass is opaque or black",
    ),
    # -- search
    Fault(
        "disk_box_by_one_axis",
        "search/bounds.py",
        "search shapes",
        "primitive_bounds",
        "((p1 - p0)[:, disks].square() + (p2 - p0)[:, disks].square()).sqrt()",
        "torch.maximum((p1 - p0)[:, disks].abs(), (p2 - p0)[:, disks].abs())",
        "disks that are turned about their own axis are cut off at four sides",
    ),
    Fault(
        "refit_keeps_bad_trees",
        "search/tree.py",
        "search render",
        "RefitState.refit",
        "cost_moved / state.built_cost",
        "1.0",
        "a tree is never built anew, however much its boxes have grown: searches take ever longer as vertices move",
    ),
    Fault(
        "any_layout",
        "native/kernels.py",
        "native search",
        "Kernel.words",
        "value.flags.c_contiguous",
        "True",
        "kernels read the wrong numbers of arrays that are not contiguous",
    ),
    # -- lanes
    Fault(
        "odd_powers",
        "compiler/operators/arithmetic.py",
        "compiler",
        "_pow",
        "graph.binary('mul', ty, square, x) if n % 2 else square",
        "square",
        "compiled stages of a model of one's own take x**3 for x**2",
    ),
    # -- gradients
    Fault(
        "clamp_has_no_derivative",
        "gradients/tape.py",
        "gradients render",
        "sample_cotangents",
        "(cotangent * scale).scatter_add(0, channel, -through_largest)",
        "cotangent * scale",
        "dropped term of a gradient: with integrator.clamp the brightest channel still pulls",
    ),
    Fault(
        "edges_pull_backwards",
        "gradients/edges/primary.py",
        "edges render",
        "Primary.samples",
        "values[:, : len(index)] - values[:, len(index) :]",
        "values[:, len(index) :] - values[:, : len(index)]",
        "wrong sign: an optimizer moves outlines away from where they belong",
    ),
    # -- scenes
    Fault(
        "changed_in_place",
        "scene/versions.py",
        "scene render",
        "VersionCounter.of",
        "tensor() is not value or before_torch_version != torch_version",
        "tensor() is not value",
        "a stale cache: a parameter changed in place by an optimizer still renders as it was",
    ),
    Fault(
        "camera_of_another_height",
        "scene/prepare.py",
        "render scene",
        "_camera",
        "([id(value) for value in objects], [value._version for value in tensors], film.width, film.height, dtype)",
        "([id(value) for value in objects], [value._version for value in tensors], film.width, dtype)",
        "a stale cache: the second picture of a scene, of another height, is seen through the first one's film",
    ),
    Fault(
        "copies_placed_twice",
        "scene/world/primitives.py",
        "scene shapes search",
        "copy_maps",
        "scene_to_lanes @ pose @ from_scene[copy.of] @ lanes_to_scene",
        "scene_to_lanes @ pose @ lanes_to_scene",
        "an instance of a mesh that has a transform is moved by both transforms",
    ),
    Fault(
        "crop_beyond_the_film",
        "scene/settings.py",
        "format cli",
        "Film.check",
        "left + crop_width > width or top + crop_height > height",
        "crop_width > width or crop_height > height",
        "an error message lost: a crop that reaches beyond the film is accepted and renders what is not on it",
    ),
    # -- meshes
    Fault(
        "obj_upside_down",
        "scene/meshes/obj.py",
        "meshes",
        "load_obj",
        "1.0 - uvs[:, 1]",
        "uvs[:, 1]",
        "row order flipped: textures of OBJ files stand on their heads",
    ),
    Fault(
        "gltf_turned_back",
        "scene/meshes/gltf_material.py",
        "meshes",
        "_Converter.texture",
        "-math.degrees(turn)",
        "math.degrees(turn)",
        "wrong sign: KHR_texture_transform turns textures the other way",
    ),
    Fault(
        "ply_never_white",
        "scene/meshes/ply.py",
        "meshes",
        "_colors",
        "np.iinfo(kinds[name]).max",
        "np.iinfo(kinds[name]).max + 1",
        "off by one: white vertices of PLY files are 255 / 256",
    ),
    # -- images
    Fault(
        "srgb_exponent",
        "images/colour.py",
        "images",
        "linear_to_srgb",
        "1 / 2.4",
        "1 / 2.2",
        "wrong colour space: PNGs are too bright, and reading them back gives other numbers",
    ),
    Fault(
        "relmse_of_the_picture",
        "images/metrics.py",
        "images reports",
        "_relative",
        "relative((x - ref).square(), ref, floor)",
        "relative((x - ref).square(), x, floor)",
        "a statistic wrong: relMSE is relative to the picture, so that fireflies count little and dark pictures much",
    ),
    # -- renders, ranks, batches
    Fault(
        "resumed_a_sample_early",
        "rendering/run.py",
        "render",
        "Run._render_state",
        "self.taken",
        "max(self.taken - 1, 0)",
        "resume point off by one: a resumed render takes one sample of each pixel twice, and is another picture",
    ),
    Fault(
        "rays_of_one_rank",
        "rendering/split.py",
        "ranks",
        "DistributedRender.take",
        "rays + sum(int(said[1]) for said in every)",
        "rays + own[1]",
        "counts wrong: a render of several ranks tells the rays of one of them",
    ),
    Fault(
        "batch_of_one_seed",
        "rendering/batches/inputs.py",
        "render",
        "seeds_of",
        "row[c] if isinstance(row, Sequence) else row",
        "row[0] if isinstance(row, Sequence) else row",
        "all cameras of a scene in a batch render with the seed of the first",
    ),
    # -- reports, stress
    Fault(
        "freedom_of_a_mean",
        "reports/statistics.py",
        "reports",
        "estimate",
        "t_quantile(len(values) - 1.0)",
        "t_quantile(len(values))",
        "a statistic wrong: 95 % bands are too narrow, a third as wide as they should be with two seeds",
    ),
    Fault(
        "clamped_reference",
        "reports/study.py",
        "reports",
        "Study.reference_overrides",
        "{**own, 'integrator.clamp': None, **self.reference.settings}",
        "{**own, **self.reference.settings}",
        "a study whose scenes or settings clamp compares with a clamped reference, and finds no bias",
    ),
    Fault(
        "no_figure_passes",
        "stress/case.py",
        "stress",
        "Outcome.passed",
        "one.refused or one.figure <= self.case.bound",
        "one.refused or not one.figure > self.case.bound",
        "a stress case that fails to measure anything is told as passed",
    ),
    # -- learning
    Fault(
        "stuck_at_its_end",
        "nn/parametrizations.py",
        "ml",
        "_ProjectedClamp.backward",
        "(x <= ctx.low) & (cotangent > 0)",
        "x <= ctx.low",
        "a parameter of torchpt.nn that has come to the low end of its range never leaves it again",
    ),
    Fault(
        "loss_of_one_render",
        "losses.py",
        "ml",
        "unbiased_relmse",
        "(a - target) * (b - target)",
        "(a - target) * (a - target)",
        "the loss that noise must not bias is biased by the noise of the first render; the second one gets no gradient",
    ),
    # -- the command line
    Fault(
        "debug_other_pixel",
        "cli/debug.py",
        "cli",
        "PathRequest.read",
        "(int(pixel[1]), int(pixel[2]))",
        "(int(pixel[2]), int(pixel[1]))",
        "swapped arguments: `debug.pixel=[x,y]` explains the pixel (y, x)",
    ),
)
