"""The matrix of numerical hard cases: each id, what it is, and the tests that prove it.

A test is named by file and function; `test_matrix` holds those that had none.
"""

from __future__ import annotations

SOLVE, ROOTS, QUADRICS = "test_solve.py::test_", "test_solve_roots.py::test_", "test_solve_quadrics.py::test_"
MAP, GRID, RASTER, HERE = (
    "test_reflector_map.py::test_",
    "test_grid.py::test_",
    "test_raster.py::test_",
    "test_matrix.py::test_",
)
FIELD, LAYERED = "test_heightfield.py::test_", "test_layered_environment.py::test_"
TRACED, SCENES, READ, FORWARD = (
    "test_raytraced.py::test_",
    "test_scenes.py::test_",
    "test_stage_read.py::test_",
    "test_forward.py::test_",
)

# id: (case, tests)
MATRIX: dict[str, tuple[str, tuple[str, ...]]] = {
    "RP01": ("eye and point coincide", (SOLVE + "coincident_eye_and_point_reflect_at_the_foot_of_the_normal",)),
    "RP02": ("point on the line through eye and mirror", (SOLVE + "sphere_status",)),
    "RP03": ("residual of angles down to 1e-6", (HERE + "residual_resolves_small_angles",)),
    "RP04": ("eye on the surface", (SOLVE + "sphere_status",)),
    "RP05": ("point on the surface", (SOLVE + "point_on_the_surface_is_its_own_reflection",)),
    "RP06": ("eye or point inside", (SOLVE + "sphere_status",)),
    "RP07": ("point hidden by the mirror", (SOLVE + "sphere_status",)),
    "RP08": ("point on the axis behind", (SOLVE + "sphere_status",)),
    "RP09": (
        "incidence of 80 to 89.99 degrees",
        (
            SOLVE + "grazing_incidence_is_resolved_or_flagged",
            SOLVE + "points_near_grazing_incidence_match_constructed_truth",
            HERE + "hard_cases_match_forty_digits",
        ),
    ),
    "RP10": ("point or eye at 1e2 to 1e8 sizes", (HERE + "hard_cases_match_forty_digits",)),
    "RP11": ("point or eye at 1e-1 to 1e-6 of the surface", (HERE + "hard_cases_match_forty_digits",)),
    "RP12": ("centre at 1e4, 1e6, 1e7", (SOLVE + "far_offset_gives_the_points_of_the_origin",)),
    "RP13": ("radius 1e-6, 1e-12", (SOLVE + "sphere_scales_exactly_by_powers_of_two",)),
    "RP14": ("radius 1e20", (SOLVE + "sphere_scales_exactly_by_powers_of_two",)),
    "RP15": (
        "directions at edges and corners of the cube",
        (HERE + "map_is_seamless_at_edges_and_corners_of_the_cube",),
    ),
    "RP16": ("the last texel of a face", (HERE + "texels_of_any_direction_are_in_range",)),
    "RP17": (
        "directions that are zero or not finite",
        (
            MAP + "bare_solver_takes_a_reflector_map",
            MAP + "search_never_answers_nan",
            HERE + "texels_of_any_direction_are_in_range",
        ),
    ),
    "RP18": ("opposite normals in neighbouring texels", (HERE + "flat_bodies_and_sharp_edges_have_finite_answers",)),
    "RP19": (
        "texels without a surface",
        (
            MAP + "bodies_no_map_can_hold_are_refused",
            "test_segments.py::test_open_and_hollow_mirrors_show_what_tracing_shows",
        ),
    ),
    "RP20": ("a body that is not star-shaped", (MAP + "bodies_no_map_can_hold_are_refused",)),
    "RP21": ("the map's centre on the surface", (HERE + "bodies_without_an_inside_are_refused",)),
    "RP22": (
        "a search that oscillates",
        (
            "test_properties.py::test_one_more_iteration_never_raises_the_residual",
            MAP + "midpoint_search_converges_with_its_iterations",
        ),
    ),
    "RP23": (
        "normals parallel to a face of the cube",
        (MAP + "newton_finds_the_constructed_point", HERE + "map_is_seamless_at_edges_and_corners_of_the_cube"),
    ),
    "RP24": ("hollow sphere: all roots", (ROOTS + "hollow_sphere_gives_the_roots_of_alhazens_quartic",)),
    "RP25": (
        "near a caustic",
        (ROOTS + "merging_roots_are_flagged_near_the_caustic", HERE + "hard_cases_match_forty_digits"),
    ),
    "RP26": ("a virtual point where R is the eye", (SOLVE + "sphere_status",)),
    "RP27": ("eye and point exchanged", ("test_properties.py::test_exchanging_eye_and_point_changes_nothing",)),
    "GI01": ("flat mesh", (HERE + "octree_holds_flat_long_far_and_equal_points",)),
    "GI02": ("vertex on the highest face", (HERE + "octree_holds_flat_long_far_and_equal_points",)),
    "GI03": ("position one rounding beyond the lattice", (HERE + "octree_holds_flat_long_far_and_equal_points",)),
    "GI04": ("corner without an answer", (GRID + "mirror_among_cells_larger_than_itself_hides_what_it_hides",)),
    "GI05": ("corners on two branches", (GRID + "tolerance_bounds_the_error_of_every_vertex",)),
    "GI06": ("box at 1e7, size 0.5", (HERE + "octree_holds_flat_long_far_and_equal_points",)),
    "GI07": ("cells beyond 2^31", (HERE + "octree_holds_flat_long_far_and_equal_points",)),
    "GI08": ("aspect 1e6:1:1", (HERE + "octree_holds_flat_long_far_and_equal_points",)),
    "GI09": ("values at the corners of cells", (GRID + "error_falls_with_the_order_of_the_kind",)),
    "Q01": ("rays from 1e4, 1e5 sizes", (QUADRICS + "far_rays_hit_the_sphere_within_four_roundings",)),
    "Q02": ("grazing rays", (HERE + "grazing_rays_hit_as_in_forty_digits",)),
    "Q03": ("roots of x^2 + 1e4 x + 1", (HERE + "rays_with_roots_far_apart_keep_both",)),
    "Q04": ("rays along the axis of a paraboloid", (QUADRICS + "paraboloid_rays_along_the_axis_have_one_root",)),
    "Q05": ("asymptotic ray of a hyperboloid", (QUADRICS + "asymptotic_ray_of_a_hyperboloid_has_no_second_root",)),
    "Q06": ("the other sheet", (QUADRICS + "sheet_follows_the_object_axis",)),
    "Q07": ("apex of a cone", (SOLVE + "cone_apex_has_no_normal",)),
    "Q08": ("ray along a cylinder's axis", (HERE + "rays_along_a_cylinder_miss",)),
    "Q09": ("tips of ellipsoids of 100:1 to 10,000:1", (HERE + "hard_cases_match_forty_digits",)),
    "Q10": ("equations without a surface", (QUADRICS + "surfaces_without_a_mirror_are_refused_by_name",)),
    "Q11": ("eye, point and axis in one plane", (ROOTS + "symmetric_positions_keep_their_pairs",)),
    "Q12": ("eye and point on the axis", (ROOTS + "rings_on_an_axis_are_ambiguous_and_fixed",)),
    "Q13": ("point on the mirror", (SOLVE + "point_on_the_surface_is_its_own_reflection",)),
    "Q14": (
        "eye and point coincide",
        (SOLVE + "coincident_eye_and_point_reflect_at_the_foot_of_the_normal", HERE + "hard_cases_match_forty_digits"),
    ),
    "Q15": ("coordinates that overflow in high degrees", (HERE + "hollow_quadrics_scale_by_powers_of_two",)),
    "Q16": ("roots close together", (ROOTS + "merging_roots_are_flagged_near_the_caustic",)),
    "Q17": ("a double root that turns complex", (ROOTS + "merging_roots_are_flagged_near_the_caustic",)),
    "Q18": ("spurious roots", (ROOTS + "all_roots_are_those_of_a_dense_scan",)),
    "Q19": (
        "R beyond the aperture",
        (SOLVE + "plane_status", "test_quadric.py::test_solid_with_rims_is_solved_patch_by_patch"),
    ),
    "H01": ("direction -0 on a border", (FIELD + "negative_zero_on_a_border_steps_along_the_other_axis",)),
    "H02": ("vertical ray", (FIELD + "vertical_ray_meets_its_column_at_a_finite_distance",)),
    "H03": ("rays that are not finite, or zero", (FIELD + "rays_that_are_no_rays_get_a_status",)),
    "H04": ("start outside, aimed in", (FIELD + "ray_from_outside_comes_in_through_the_box",)),
    "H05": ("start on the far edge", (FIELD + "ray_from_the_far_edge_starts_in_the_last_column",)),
    "H06": ("start on a border, backwards", (FIELD + "ray_from_a_border_starts_in_the_column_that_it_enters",)),
    "H07": ("through corners", (FIELD + "diagonal_through_corners_goes_between_no_two_columns",)),
    "H08": ("components of 1e-30, directions of 1e-38", (FIELD + "tiny_components_and_tiny_directions_are_scaled",)),
    "H09": ("1,024 to 16,384 cells", (FIELD + "long_rays_stay_in_their_cells",)),
    "H10": ("heights that are not finite", (FIELD + "columns_without_a_height_are_open",)),
    "H11": ("ray at the height of a column", (FIELD + "ray_at_the_height_of_a_column_meets_it",)),
    "H12": ("start below the ground", (FIELD + "start_below_the_ground_is_told",)),
    "H13": ("grids of one cell and of none", (FIELD + "smallest_grids_and_none",)),
    "H14": (
        "no walk without an end",
        (
            FIELD + "step_limit_ends_a_walk_and_no_ray_of_the_corpus_reaches_it",
            FIELD + "heightfield_answers_as_every_column_asked",
            FIELD + "grid_of_cells_answers_as_every_cell_asked",
        ),
    ),
    "H15": ("cells of 0.5 at 1e7", (FIELD + "cells_are_found_far_from_the_origin",)),
    "H16": ("sinks below a roof within a cell", (FIELD + "ray_that_sinks_below_a_roof_within_a_cell_meets_it_there",)),
    "E01": ("reference maps at one place", (LAYERED + "maps_at_one_place_share_alike",)),
    "E02": ("point beyond the axis of two maps", (LAYERED + "weights_add_up_to_one_beyond_the_axis",)),
    "E03": ("seen by no map", (LAYERED + "what_no_map_sees_is_shaded_or_flagged",)),
    "E04": ("point at the eye of a map", (LAYERED + "point_at_the_eye_of_a_map_is_seen_by_the_other",)),
    "E05": ("point on a surface at 80 degrees", (LAYERED + "surface_seen_at_an_angle_does_not_hide_itself",)),
    "E06": ("sky, which has no distance", (LAYERED + "sky_has_no_distance_and_no_weights",)),
    "E07": ("weights (0, 1e-38)", (LAYERED + "weights_that_vanish_are_one_maps",)),
    "E08": ("depths of 0, and none", (LAYERED + "edges_against_the_sky_are_refined_at_any_depth",)),
    "E09": (
        "samples of a picture that are no light",
        ("test_images.py::test_bad_samples_are_replaced_and_counted_on_reading",),
    ),
    "P01": ("plane with normal (0, -1, 0)", (SOLVE + "plane_mirrors_the_point",)),
    "P02": ("plane tilted by 1e-3, 3e-4 from it", (SOLVE + "plane_mirrors_the_point",)),
    "P03": ("normal zero or tiny", (SOLVE + "plane_mirrors_the_point", SOLVE + "refusals_name_the_argument")),
    "P04": (
        "eye in the plane",
        (SOLVE + "eye_in_a_tilted_plane_is_hidden", FORWARD + "plane_seen_edge_on_or_from_its_plane_is_finite"),
    ),
    "P05": ("eye behind the plane", (SOLVE + "plane_status",)),
    "P06": (
        "plane at 1e7",
        (HERE + "far_plane_mirrors_as_near", HERE + "far_points_reflect_in_a_plane_where_they_should"),
    ),
    "P07": ("mirrored twice", (SOLVE + "plane_mirrors_twice_to_itself",)),
    "P08": ("mirrored transform", (HERE + "mirrored_transform_shows_the_baked_mesh",)),
    "P09": ("what stands behind the mirror's plane", (FORWARD + "planar_equals_the_picture_of_a_mirrored_eye",)),
    "P10": ("mirrors that see each other", ("test_shade.py::test_a_mirror_seen_in_a_mirror_shows_base_and_dome",)),
    "R01": ("vertices at and behind the eye", (RASTER + "near_plane_clipping_matches_ray_oracle",)),
    "R02": ("all behind", (RASTER + "everything_behind_draws_nothing",)),
    "R03": ("a triangle of 1e9 pixels", (RASTER + "huge_triangles_are_clipped_to_the_guard_band",)),
    "R04": ("triangles of 1e-6 pixels", (HERE + "tiny_triangles_own_a_pixel_once",)),
    "R05": ("shared edges", (RASTER + "shared_edges_own_each_pixel_once",)),
    "R06": ("long edges", (RASTER + "coverage_matches_integer_oracle", HERE + "long_edges_have_one_side")),
    "R07": (
        "equal depths",
        (RASTER + "equal_depth_goes_to_lower_id", RASTER + "result_does_not_depend_on_order_or_threads"),
    ),
    "R08": ("zero area", (RASTER + "dropped_and_zero_area_triangles_draw_nothing",)),
    "R09": ("near 1e-3, far 1e7", (HERE + "depths_near_1000_stay_apart",)),
    "R10": (
        "impossible cameras",
        (
            READ + "impossible_camera_is_named_and_dropped",
            "test_cli.py::test_impossible_requests_end_with_one_line_and_2",
        ),
    ),
    "R11": ("vertices that are not finite", (HERE + "vertices_that_are_not_finite_draw_nothing",)),
    "S01": ("edges of 1e-12", (TRACED + "unit_and_facet_normal_hold_at_every_scale",)),
    "S02": ("units and axes", (HERE + "units_and_up_axis_do_not_change_the_picture",)),
    "S03": (
        "far offsets",
        (
            SCENES + "picture_does_not_change_far_from_the_origin",
            TRACED + "intersect_triangle_matches_float64_over_scales",
        ),
    ),
    "S04": (
        "values beyond float32",
        (
            READ + "bad_mesh_is_dropped_with_its_reason",
            "test_hostile.py::test_hostile_files_end_in_a_scene_or_one_line",
        ),
    ),
    "S05": ("denormal sizes", (HERE + "denormal_points_are_answered",)),
}
COUNTS = {"RP": 27, "GI": 9, "Q": 19, "H": 16, "E": 9, "P": 10, "R": 11, "S": 5}
