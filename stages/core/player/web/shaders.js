// The programs of the renderer, in GLSL.

// A splat of each Gaussian, once per picture: moved by its keypoints, projected to an ellipse and coloured.
// Projection and limits are those of stages/core/kernels/splat/projection.py.
export const PROJECT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

const float BLUR = 0.3, MIN_ALPHA = 1.0 / 255.0;

in uint gaussian;
uniform sampler2D gaussians; // 3 texels each: centre, opacity | quaternion w x y z | scales, object
uniform sampler2D harmonics; // a texel for each coefficient
uniform usampler2D bindings; // 2 texels each: eight keypoints of 16 bits | eight weights of 8 bits
uniform sampler2D motion; // 3 texels for each keypoint: rows (G, c) of its affine displacement
uniform sampler2D objects; // a texel each: flat colour, and 0 hidden, 1 shown or 2 highlighted
uniform sampler2D restIrradiance; // four Gaussians a texel: what their colours hold
uniform sampler2D occluders; // of shadows.js
uniform int casters; // objects in it; 0 draws no shadows
uniform vec4 light; // shares of sky and lamp, tangent of the lamp's angular radius, irradiance beneath objects
uniform vec3 lamp; // direction to it
uniform uint bound, coefficients; // Gaussians that follow keypoints, the first ones; harmonics of each
uniform mat3 rotation; // world to camera
uniform vec3 translation, eye, depths; // depths: nearest drawn, range of the colours of depth
uniform vec4 intrinsics; // fx fy cx cy [px]
uniform vec2 size; // [px]
uniform int mode; // 0 photo colours, 1 objects, 2 depth, 3 displacement
uniform float reach; // displacement that has the last colour

out vec4 splat; // centre [px]; gaussian and depth
out vec4 axes; // semi-axes of one standard deviation [px]
out vec4 paint; // colour and opacity

ivec2 texel(uint i) { return ivec2(i & 4095u, i >> 12); }

mat3 turn(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return transpose(mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
    2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
    2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)));
}

// Polar factor by Newton's iteration, as in stages/core/kernels/skinning.py; columns made orthogonal where F is inverted.
mat3 rotationOf(mat3 F) {
  if (determinant(F) <= 1e-3) {
    vec3 x = normalize(F[0] + vec3(1e-9, 0.0, 0.0)), y = normalize(F[1] - dot(F[1], x) * x + vec3(0.0, 1e-9, 0.0));
    return mat3(x, y, cross(x, y));
  }
  for (int i = 0; i < 14; i++) {
    mat3 next = 0.5 * (F + transpose(inverse(F)));
    vec3 change = abs(next[0] - F[0]) + abs(next[1] - F[1]) + abs(next[2] - F[2]);
    F = next;
    if (change.x + change.y + change.z < 1e-5) break;
  }
  return F;
}

vec3 harmonic(uint i) { return texelFetch(harmonics, texel(gaussian * coefficients + i), 0).rgb; }

// Colour along the unit direction d; basis as in stages/core/geometry/harmonics.py.
vec3 colour(vec3 d) {
  float x = d.x, y = d.y, z = d.z;
  vec3 c = 0.5 + 0.28209479177387814 * harmonic(0u);
  if (coefficients > 1u)
    c += 0.4886025119029199 * (-y * harmonic(1u) + z * harmonic(2u) - x * harmonic(3u));
  if (coefficients > 4u) {
    const float k = 1.0925484305920792;
    c += k * x * y * harmonic(4u) - k * y * z * harmonic(5u) + 0.31539156525252005 * (3.0 * z * z - 1.0) * harmonic(6u)
      - k * x * z * harmonic(7u) + 0.5 * k * (x * x - y * y) * harmonic(8u);
  }
  if (coefficients > 9u) {
    const float a = 0.5900435899266435, b = 2.890611442640554, k = 0.4570457994644658;
    c += -a * y * (3.0 * x * x - y * y) * harmonic(9u) + b * x * y * z * harmonic(10u)
      - k * y * (5.0 * z * z - 1.0) * harmonic(11u) + 0.3731763325901154 * z * (5.0 * z * z - 3.0) * harmonic(12u)
      - k * x * (5.0 * z * z - 1.0) * harmonic(13u) + 0.5 * b * z * (x * x - y * y) * harmonic(14u)
      - a * x * (x * x - 3.0 * y * y) * harmonic(15u);
  }
  return max(c, 0.0);
}

// Irradiance at x on an object: that of stages/core/raster/shadows.py.
float irradiance(vec3 x, float object) {
  vec2 logs = vec2(0.0);
  for (int o = 0; o < casters; o++) {
    vec4 ball = texelFetch(occluders, texel(uint(2 * o)), 0), row = texelFetch(occluders, texel(uint(2 * o + 1)), 0);
    if (row.x == object || row.w == 0.0) continue;
    vec3 v = ball.xyz - x;
    float R = ball.w, square = dot(v, v), along = dot(v, lamp), across = sqrt(max(square - along * along, 0.0));
    bool sky = R * R * (v.z + R) > 0.01 * square * sqrt(square);
    if (!sky && !(along > -R && across < R + light.z * (along + R))) continue;
    vec2 seen = vec2(1.0);
    for (int i = int(row.y); i < int(row.y + row.z); i++) {
      vec4 sphere = texelFetch(occluders, texel(uint(i)), 0);
      v = sphere.xyz - x;
      float r = sphere.w;
      square = max(dot(v, v), 1e-12);
      along = dot(v, lamp);
      across = sqrt(max(square - along * along, 0.0));
      float disc = max(light.z * along, 1e-6);
      float edge = smoothstep(0.0, 1.0, (across - abs(disc - r)) / (2.0 * min(disc, r)));
      vec2 hidden = vec2(max(v.z, 0.0) * inversesqrt(square) * min(r * r / square, 1.0),
                         along > 0.0 ? min(r * r / (disc * disc), 1.0) * (1.0 - edge) : 0.0);
      seen *= 1.0 - min(hidden, 0.999);
    }
    logs += row.w * log(seen);
  }
  return 1.0 - dot(light.xy, 1.0 - exp(logs));
}

float shadow(vec3 x, float object) { // factor of the colour
  float now = irradiance(x, object), rest = texelFetch(restIrradiance, texel(gaussian >> 2), 0)[gaussian & 3u];
  return pow(now / (now < rest ? rest : max(rest, min(now, light.w))), 1.0 / 2.2);
}

vec3 ramp(float t) { // bright to dark
  const vec3 colours[5] = vec3[5](vec3(0.99, 0.93, 0.60), vec3(0.98, 0.62, 0.30), vec3(0.85, 0.27, 0.34),
                                  vec3(0.49, 0.14, 0.45), vec3(0.09, 0.07, 0.25));
  float at = 4.0 * clamp(t, 0.0, 1.0);
  int first = min(int(at), 3);
  return mix(colours[first], colours[first + 1], at - float(first));
}

void main() {
  splat = vec4(-1e6, -1e6, 0.0, 0.0);
  axes = paint = vec4(0.0);
  vec4 first = texelFetch(gaussians, texel(3u * gaussian), 0);
  vec4 last = texelFetch(gaussians, texel(3u * gaussian + 2u), 0);
  vec4 shown = texelFetch(objects, texel(uint(last.w)), 0);
  float opacity = first.w;
  if (opacity < MIN_ALPHA || shown.w == 0.0) return;

  vec3 X = first.xyz, shift = vec3(0.0);
  mat3 F = mat3(1.0);
  if (gaussian < bound) {
    uvec4 index = texelFetch(bindings, texel(2u * gaussian), 0), weight = texelFetch(bindings, texel(2u * gaussian + 1u), 0);
    vec4 rows[3] = vec4[3](vec4(0.0), vec4(0.0), vec4(0.0));
    float total = 0.0;
    for (int j = 0; j < 8; j++) {
      float w = float((weight[j >> 2] >> uint(8 * (j & 3))) & 255u);
      uint k = (index[j >> 1] >> uint(16 * (j & 1))) & 65535u;
      total += w;
      for (uint r = 0u; r < 3u; r++) rows[r] += w * texelFetch(motion, texel(3u * k + r), 0);
    }
    for (int r = 0; r < 3; r++) rows[r] /= total;
    shift = vec3(dot(rows[0], vec4(X, 1.0)), dot(rows[1], vec4(X, 1.0)), dot(rows[2], vec4(X, 1.0)));
    F += transpose(mat3(rows[0].xyz, rows[1].xyz, rows[2].xyz));
  }
  vec3 x = X + shift, p = rotation * x + translation;
  if (p.z < depths.x || p.z >= 1e10) return;

  vec2 slope = p.xy / p.z, centre = intrinsics.xy * slope + intrinsics.zw;
  vec2 margin = 0.15 * size / intrinsics.xy; // beyond, the linearisation is unbounded
  vec2 c = clamp(slope, -intrinsics.zw / intrinsics.xy - margin, (size - intrinsics.zw) / intrinsics.xy + margin);
  mat3 RS = F * turn(normalize(texelFetch(gaussians, texel(3u * gaussian + 1u), 0)));
  RS = rotation * mat3(RS[0] * last.x, RS[1] * last.y, RS[2] * last.z);
  vec3 a = intrinsics.x / p.z * (vec3(RS[0].x, RS[1].x, RS[2].x) - c.x * vec3(RS[0].z, RS[1].z, RS[2].z));
  vec3 b = intrinsics.y / p.z * (vec3(RS[0].y, RS[1].y, RS[2].y) - c.y * vec3(RS[0].z, RS[1].z, RS[2].z));

  // principal axes of the covariance [A B; B C]
  float aa = dot(a, a), bb = dot(b, b), B = dot(a, b), A = aa + BLUR, C = bb + BLUR;
  vec3 n = cross(a, b);
  float det = dot(n, n) + BLUR * (aa + bb) + BLUR * BLUR;
  float larger = 0.5 * (A + C) + length(vec2(0.5 * (A - C), B));
  vec2 along = A >= C ? vec2(larger - C, B) : vec2(B, larger - A);
  along = dot(along, along) > 0.0 ? normalize(along) : vec2(1.0, 0.0);

  float radius = sqrt(2.0 * log(opacity / MIN_ALPHA));
  vec2 extent = radius * sqrt(vec2(A, C));
  if (any(lessThanEqual(centre + extent, vec2(0.0))) || any(greaterThanEqual(centre - extent, size))) return;
  splat = vec4(centre, float(gaussian), p.z);
  axes = vec4(sqrt(larger) * along, sqrt(det / larger) * vec2(-along.y, along.x));
  vec3 rgb;
  if (mode == 0) {
    rgb = colour(transpose(coefficients > 1u ? rotationOf(F) : mat3(1.0)) * normalize(x - eye));
    if (casters > 0) rgb *= shadow(x, last.w);
  }
  else if (mode == 1)
    rgb = last.w > 0.0 ? shown.rgb
      : vec3(0.35 + 0.5 * dot(clamp(0.5 + 0.28209479177387814 * harmonic(0u), 0.0, 1.0), vec3(1.0 / 3.0)));
  else if (mode == 2) rgb = ramp((p.z - depths.y) / (depths.z - depths.y));
  else rgb = last.w > 0.0 ? ramp(1.0 - length(shift) / reach) : vec3(0.25);
  if (shown.w == 2.0) rgb = mix(rgb, vec3(1.0, 0.85, 0.3), 0.35);
  paint = vec4(rgb, opacity);
}`;

// A quad around the part of a splat in which its alpha is at least MIN_ALPHA; four vertices for each splat, which are read
// from a texture: an instance for each would be a call of its own where drawing is done by software.
export const QUAD = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D splats; // 3 texels each, as PROJECT writes them
uniform vec2 size;
out vec2 position; // in standard deviations
flat out vec4 of, at;
void main() {
  int first = 3 * (gl_VertexID >> 2);
  vec4 row[3];
  for (int i = 0; i < 3; i++) row[i] = texelFetch(splats, ivec2((first + i) & 4095, (first + i) >> 12), 0);
  at = row[0];
  of = row[2];
  float radius = sqrt(2.0 * log(max(255.0 * of.a, 1.0))) + 1e-3;
  position = radius * (2.0 * vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) - 1.0);
  vec2 pixel = at.xy + position.x * row[1].xy + position.y * row[1].zw;
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}`;

export const BLEND = `#version 300 es
precision highp float;
in vec2 position;
flat in vec4 of, at;
out vec4 pixel;
void main() {
  float alpha = min(0.999, of.a * exp(-0.5 * dot(position, position)));
  if (alpha < 1.0 / 255.0) discard;
  pixel = vec4(alpha * of.rgb, alpha);
}`;

// The Gaussian in front at a pixel, and its depth.
export const PICK = `#version 300 es
precision highp float;
precision highp int;
in vec2 position;
flat in vec4 of, at;
out uvec4 pixel;
void main() {
  if (of.a * exp(-0.5 * dot(position, position)) < 0.3) discard;
  pixel = uvec4(uint(at.z) + 1u, floatBitsToUint(at.w), 0u, 0u);
}`;

export const COVER = `#version 300 es
void main() { gl_Position = vec4(4.0 * float(gl_VertexID & 1) - 1.0, 4.0 * float(gl_VertexID >> 1) - 1.0, 0.0, 1.0); }`;

// The picture, which may be smaller than the canvas, over the background.
export const PRESENT = `#version 300 es
precision highp float;
uniform sampler2D picture;
uniform vec3 background;
uniform vec2 scale;
out vec4 pixel;
void main() {
  vec4 c = texture(picture, gl_FragCoord.xy * scale);
  pixel = vec4(c.rgb + (1.0 - c.a) * background, 1.0);
}`;
