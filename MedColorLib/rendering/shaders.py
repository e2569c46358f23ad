"""Changes to the text of VTK's ray caster, in its own language GLSL; no VTK here.

Each is a pair: a text that VTK writes, and what stands there instead (vtkShaderProperty.AddFragmentShaderReplacement). The
texts are the same from VTK 9.1 to 9.6. Where a later VTK words one differently nothing is replaced there: the picture is
as right as before, but slower, or its surfaces are less smooth.
"""

from __future__ import annotations

Replacement = tuple[str, str]

# VTK before 9.4 takes the direction of a surface from the first component, red, instead of alpha: where colour goes on
# outside tissue (`surface`), red has no edge. Later versions have component = 3 here.
NORMAL_FROM_COMPONENT = "computeGradient(g_dataPos, component, in_volume[0], 0)"
NORMAL_FROM_ALPHA = "computeGradient(g_dataPos, 3, in_volume[0], 0)"

# Free voxels around an air voxel, as `free_air` has written them into red: a ray goes on by whole steps, so that the
# samples in tissue are the same as without.
SKIP_AIR: Replacement = (
    "g_srcColor.a = computeOpacity(scalar);",
    """g_srcColor.a = computeOpacity(scalar);
      if (scalar.a == 0.0 && scalar.g == 0.0 && scalar.b == 0.0)
        {
        vec3 mcVoxels = abs(g_dirStep) / in_cellStep[0];
        float mcSteps = floor(255.0 * scalar.r / max(max(mcVoxels.x, mcVoxels.y), mcVoxels.z));
        g_dataPos += mcSteps * g_dirStep;
        g_currentT += mcSteps;
        }
""",
)

# The same for the rays that look for shadows, which also end where it is dark. Only the first lamp throws shadows: the
# second shines from the viewer, and what it does not reach is not seen.
SHADOWS: tuple[Replacement, ...] = (
    (
        "opacity = computeOpacity(vec4(scalar));",
        """opacity = computeOpacity(vec4(scalar));
  vec4 mcAir = scalar == 0.0 ? texture3D(volume, sampled_point) : vec4(1.0);
  if (mcAir.a == 0.0 && mcAir.g == 0.0 && mcAir.b == 0.0)
    {
    vec3 mcVoxels = abs(norm_dir) / in_cellStep[0];
    current_dist += 255.0 * mcAir.r / max(max(mcVoxels.x, mcVoxels.y), mcVoxels.z);
    }
""",
    ),
    ("while(current_dist < maxdist)", "while(current_dist < maxdist && shadow > 0.02)"),
    (
        "vol_shadow = volumeShadow(g_dataPos, tex_light, 0.0, component, in_volume[0], 0, label);",
        "vol_shadow = dirNum > NUMBER_POS_LIGHTS ? 1.0 : "
        "volumeShadow(g_dataPos, tex_light, 0.0, component, in_volume[0], 0, label);",
    ),
)

# A surface's direction from the gradients at four places around a sample, which lie like the corners of a tetrahedron.
# The gradient of a single sample follows the steps of 8-bit voxels and the corner where the ramp at a skin begins.
# VTK's own function is asked, since it knows clipping planes; where it returns unit vectors, w is their length.
_AROUND = " + ".join(
    f"mcWeighed(computeGradient(g_dataPos + in_cellStep[0] * vec3({x}, {y}, {z}), component, in_volume[0], 0))"
    for x, y, z in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
)
SMOOTH_NORMALS: Replacement = (NORMAL_FROM_COMPONENT, f"({_AROUND})")
# To be replaced before VTK puts its functions there.
SMOOTH_NORMALS_NEED: Replacement = (
    "//VTK::ComputeLighting::Dec",
    """vec4 mcWeighed(vec4 g)
{
  return 0.25 * (g.w < 0.0 ? g : vec4(g.xyz * g.w, g.w));
}
//VTK::ComputeLighting::Dec""",
)
