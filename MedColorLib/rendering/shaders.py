"""Changes to the text of VTK's ray caster, in its own language GLSL; no VTK here.

Each is a pair: a text that VTK writes, and what stands there instead (vtkShaderProperty.AddFragmentShaderReplacement). The
texts are the same from VTK 9.1 to 9.6. Where a later VTK words one differently nothing is replaced there: the picture is
as right as before, but slower, or its surfaces are less smooth.
"""

from __future__ import annotations

Replacement = tuple[str, str]

# What VTK computes the direction of a surface from: six voxels around a sample. VTK before 9.4 even takes red instead of
# alpha, and where colour goes on outside tissue (`surface`), red has no edge. Later versions have component = 3 here.
NORMAL = "computeGradient(g_dataPos, component, in_volume[0], 0)"

# The eight corners of a cube around a sample: smoother, and no slower. Where voxels are no cubes it is as long, in millimetres,
# as the thickest side asks for, but at most 2.5 times a voxel: else the steps from slice to slice would show.
CUBE_NORMALS: Replacement = (NORMAL, "mcSlope(g_dataPos)")
CUBE_NORMALS_NEED: Replacement = (  # to be replaced before VTK puts its functions there
    "//VTK::ComputeLighting::Dec",
    """vec4 mcSlope(vec3 place)
{
  vec3 spacing = in_cellSpacing[0];
  vec3 voxels = min(vec3(max(max(spacing.x, spacing.y), spacing.z)) / spacing, vec3(2.5));
  vec3 slope = vec3(0.0);
  for (int n = 0; n < 8; ++n)
    {
    vec3 corner = vec3(n & 1, (n >> 1) & 1, n >> 2) * 2.0 - 1.0;
    slope += corner * texture3D(in_volume[0], place + 0.8 * corner * voxels * in_cellStep[0]).a;
    }
  return vec4(slope / (voxels * spacing), -1.0);
}
//VTK::ComputeLighting::Dec""",
)

# Free voxels around an air voxel, as `free_air` has written them into red: a ray goes on by whole steps, so that the
# samples in tissue are the same as without. The voxel itself is read, not between voxels: where a renderer interpolates in
# 8 bits (Mesa 20), a little green or blue vanishes there, and red tissue would be taken for free air.
_VOXEL_AT = "texelFetch({0}, min(ivec3({1} * vec3(textureSize({0}, 0))), textureSize({0}, 0) - 1), 0)"
SKIP_AIR: Replacement = (
    "g_srcColor.a = computeOpacity(scalar);",
    f"""g_srcColor.a = computeOpacity(scalar);
      if (scalar.a == 0.0 && scalar.g == 0.0 && scalar.b == 0.0)
        {{
        vec4 mcAir = {_VOXEL_AT.format("in_volume[0]", "g_dataPos")};
        float mcFree = mcAir.a == 0.0 && mcAir.g == 0.0 && mcAir.b == 0.0 ? 255.0 * mcAir.r : 0.0;
        vec3 mcVoxels = abs(g_dirStep) / in_cellStep[0];
        float mcSteps = floor(mcFree / max(max(mcVoxels.x, mcVoxels.y), mcVoxels.z));
        g_dataPos += mcSteps * g_dirStep;
        g_currentT += mcSteps;
        }}
""",
)

# A ray ends where 98 % of what it brings is known, not 99.6 %: what lies behind is taken for of the same colour.
_ENOUGH = 0.98
END_SOONER: tuple[Replacement, ...] = (
    ("if((g_fragColor.a > g_opacityThreshold) ||", f"if((g_fragColor.a > {_ENOUGH}) ||"),
    (
        "g_fragColor.r = g_fragColor.r * in_scale + in_bias * g_fragColor.a;",
        f"""if (g_fragColor.a > {_ENOUGH}) g_fragColor /= g_fragColor.a;
  g_fragColor.r = g_fragColor.r * in_scale + in_bias * g_fragColor.a;""",
    ),
)

# As with `SKIP_AIR` for the rays that look for shadows, which also end where it is dark. Only the first lamp throws shadows: the
# second shines from the viewer, and what it does not reach is not seen.
SHADOWS: tuple[Replacement, ...] = (
    (
        "opacity = computeOpacity(vec4(scalar));",
        f"""opacity = computeOpacity(vec4(scalar));
  vec4 mcAir = scalar == 0.0 ? {_VOXEL_AT.format("volume", "sampled_point")} : vec4(1.0);
  if (mcAir.a == 0.0 && mcAir.g == 0.0 && mcAir.b == 0.0)
    {{
    vec3 mcVoxels = abs(norm_dir) / in_cellStep[0];
    current_dist += 255.0 * mcAir.r / max(max(mcVoxels.x, mcVoxels.y), mcVoxels.z);
    }}
""",
    ),
    ("while(current_dist < maxdist)", "while(current_dist < maxdist && shadow > 0.02)"),
    (
        "vol_shadow = volumeShadow(g_dataPos, tex_light, 0.0, component, in_volume[0], 0, label);",
        "vol_shadow = dirNum > NUMBER_POS_LIGHTS ? 1.0 : "
        "volumeShadow(g_dataPos, tex_light, 0.0, component, in_volume[0], 0, label);",
    ),
)

# In Slicer, where clipping planes cut and any curve of gradient opacity may be set, VTK's own function is asked
# at four places around a sample, which lie like the corners of a tetrahedron. Where it returns unit vectors, w is their
# length. The gradient of a single place follows the steps of 8-bit voxels and the corner where the ramp at a skin begins.
_AROUND = " + ".join(
    f"mcWeighed(computeGradient(g_dataPos + in_cellStep[0] * vec3({x}, {y}, {z}), component, in_volume[0], 0))"
    for x, y, z in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
)
SMOOTH_NORMALS: Replacement = (NORMAL, f"({_AROUND})")
SMOOTH_NORMALS_NEED: Replacement = (
    "//VTK::ComputeLighting::Dec",
    """vec4 mcWeighed(vec4 g)
{
  return 0.25 * (g.w < 0.0 ? g : vec4(g.xyz * g.w, g.w));
}
//VTK::ComputeLighting::Dec""",
)
