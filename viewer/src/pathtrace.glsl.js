// The path tracer of the page: the BRDF of relit.materials.brdf and the estimator of relit.reference.path, sample by sample.
// One sample a pixel and call; the sums of all calls are kept in a float target (tracer.js).
import { BVHShaderGLSL } from "three-mesh-bvh";

export const vertexShader = /* glsl */ `
out vec2 vUv;
void main() { vUv = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }
`;

export const fragmentShader = /* glsl */ `
#define BVH_STACK_DEPTH 48
precision highp float;
precision highp int;
precision highp isampler2D;
precision highp usampler2D;
${BVHShaderGLSL.common_functions}
${BVHShaderGLSL.bvh_struct_definitions}
${BVHShaderGLSL.bvh_ray_functions}

const float PI = 3.14159265358979;
const float MIN_ALPHA = 0.0064;
const float MIN_COS = 0.02;
const float MAX_SHIFT = 0.05; // of the triangle's longest edge, see relit.reference.path
const int TABLE = 32;

uniform BVH bvh;
uniform sampler2D normals, uvs, tangents; // vertex attributes
uniform bool hasUv, hasTangents;
uniform sampler2D baseMap, roughMetalMap, normalMap, specularMap;
uniform vec3 baseFactor, specularFactor;
uniform float roughnessFactor, metallicFactor, f0;
uniform bool hasBase, hasRoughMetal, hasNormal, hasSpecular, white;
uniform sampler2D lobeTable; // TABLE x TABLE, see relit.materials.brdf.albedo_table
uniform sampler2D environment, rowCdf, cellCdf;
uniform ivec2 cells; // of the distribution: columns, rows
uniform bool hasEnvironment, hasPoint;
uniform mat3 lightFromAsset;
uniform vec3 pointPosition, pointIntensity;
uniform mat4 assetFromCamera, cameraFromClip;
uniform vec2 size; // pixels
uniform uint seed;
uniform int maxDepth; // longest path in edges: 2 = direct light only
uniform float epsilon; // length by which rays leave the surface
uniform sampler2D before; // the sums so far

in vec2 vUv;
out vec4 sum;

// ---- random numbers: PCG hash (Jarzynski & Olano 2020)
uvec3 state;
vec3 random3() {
  state = state * 1664525u + 1013904223u;
  state.x += state.y * state.z; state.y += state.z * state.x; state.z += state.x * state.y;
  state ^= state >> 16u;
  state.x += state.y * state.z; state.y += state.z * state.x; state.z += state.x * state.y;
  return vec3(state >> 8u) * (1.0 / 16777216.0);
}

// ---- environment: Mitsuba's lat-long axes, row 0 is +Y, u(+X) = .25, u(+Z) = .5
vec2 uvOf(vec3 d) {
  float u = atan(d.x, -d.z) / (2.0 * PI);
  return vec2(u - floor(u), acos(clamp(d.y, -1.0, 1.0)) / PI);
}
vec3 radiance(vec3 d) { return hasEnvironment ? textureLod(environment, uvOf(lightFromAsset * d), 0.0).rgb : vec3(0.0); }

float row(int r) { return r < 0 ? 0.0 : texelFetch(rowCdf, ivec2(r, 0), 0).r; }
float cell(int c, int r) { return c < 0 ? 0.0 : texelFetch(cellCdf, ivec2(c, r), 0).r; }
float densityOf(int c, int r, float sinTheta) {
  float p = (row(r) - row(r - 1)) * (cell(c, r) - cell(c - 1, r));
  return p * float(cells.x * cells.y) / max(2.0 * PI * PI * sinTheta, 1e-6);
}
float lightPdf(vec3 d) {
  if (!hasEnvironment) return 0.0;
  vec3 l = lightFromAsset * d;
  vec2 uv = uvOf(l);
  ivec2 c = min(ivec2(uv * vec2(cells)), cells - 1);
  return densityOf(c.x, c.y, sqrt(max(1.0 - l.y * l.y, 0.0)));
}
vec3 sampleLight(vec2 u, out float pdf) {
  int low = 0, high = cells.y - 1;
  while (low < high) { int m = (low + high) / 2; if (row(m) < u.y) low = m + 1; else high = m; }
  int r = low;
  float fy = clamp((u.y - row(r - 1)) / max(row(r) - row(r - 1), 1e-12), 0.0, 1.0);
  low = 0; high = cells.x - 1;
  while (low < high) { int m = (low + high) / 2; if (cell(m, r) < u.x) low = m + 1; else high = m; }
  float fx = clamp((u.x - cell(low - 1, r)) / max(cell(low, r) - cell(low - 1, r), 1e-12), 0.0, 1.0);
  float phi = 2.0 * PI * (float(low) + fx) / float(cells.x), theta = PI * (float(r) + fy) / float(cells.y);
  float s = sin(theta);
  pdf = densityOf(low, r, s);
  return transpose(lightFromAsset) * vec3(s * sin(phi), cos(theta), -s * cos(phi));
}

// ---- material
struct Surface { vec3 base; float roughness; float metallic; vec3 f0; };

float ggxD(float nh, float a) { float a2 = a * a, t = nh * nh * (a2 - 1.0) + 1.0; return a2 / (PI * t * t); }
float smithV(float nl, float nv, float a) {
  float a2 = a * a;
  return 0.5 / max(nl * sqrt(nv * nv * (1.0 - a2) + a2) + nv * sqrt(nl * nl * (1.0 - a2) + a2), 1e-7);
}
vec3 schlick(vec3 f, float vh) { float c = max(1.0 - vh, 0.0), c2 = c * c; return f + (1.0 - f) * (c2 * c2 * c); }
float alphaOf(Surface m) { return max(m.roughness * m.roughness, MIN_ALPHA); }
vec3 specularF0(Surface m) { return mix(m.f0, m.base, m.metallic); }
float lobeAlbedo(float nv, float roughness) {
  float x = clamp(nv * float(TABLE) - 0.5, 0.0, float(TABLE - 1)), y = clamp(roughness, 0.0, 1.0) * float(TABLE - 1);
  int x0 = min(int(x), TABLE - 2), y0 = min(int(y), TABLE - 2);
  float fx = x - float(x0), fy = y - float(y0);
  float a = mix(texelFetch(lobeTable, ivec2(x0, y0), 0).r, texelFetch(lobeTable, ivec2(x0 + 1, y0), 0).r, fx);
  float b = mix(texelFetch(lobeTable, ivec2(x0, y0 + 1), 0).r, texelFetch(lobeTable, ivec2(x0 + 1, y0 + 1), 0).r, fx);
  return mix(a, b, fy);
}
vec3 evaluate(Surface m, vec3 n, vec3 v, vec3 l) {
  float nl = max(dot(n, l), 0.0), nv = max(dot(n, v), MIN_COS);
  if (nl <= 0.0) return vec3(0.0);
  vec3 h = normalize(v + l);
  float nh = clamp(dot(n, h), 0.0, 1.0), vh = clamp(dot(v, h), 0.0, 1.0), a = alphaOf(m);
  vec3 f = specularF0(m);
  vec3 compensation = 1.0 + f * (1.0 / max(lobeAlbedo(nv, m.roughness), 0.05) - 1.0); // Turquin 2019, Eq. 15
  vec3 specular = schlick(f, vh) * compensation * (ggxD(nh, a) * smithV(nl, nv, a));
  vec3 diffuse = m.base * (1.0 - m.metallic) * (1.0 - schlick(m.f0, vh)) / PI;
  return white ? vec3(nl / PI) : (diffuse + specular) * nl;
}
float brightness(vec3 c) { return dot(c, vec3(0.2126, 0.7152, 0.0722)); }
float specularShare(Surface m, vec3 n, vec3 v) {
  if (white) return 0.0;
  float s = brightness(schlick(specularF0(m), max(dot(n, v), MIN_COS))), d = brightness(m.base) * (1.0 - m.metallic);
  return clamp(s / max(s + d, 1e-4), 0.15, 0.95);
}
mat3 frameOf(vec3 n) { // Duff et al. 2017
  float s = n.z >= 0.0 ? 1.0 : -1.0, a = -1.0 / (s + n.z), b = n.x * n.y * a;
  return mat3(vec3(1.0 + s * n.x * n.x * a, s * b, -s * n.x), vec3(b, s + n.y * n.y * a, -n.y), n);
}
vec3 seen(mat3 frame, vec3 v) { vec3 w = transpose(frame) * v; w.z = max(w.z, MIN_COS); return normalize(w); }
vec3 sampleBrdf(Surface m, vec3 n, vec3 v, vec3 u) {
  mat3 frame = frameOf(n);
  if (u.z < specularShare(m, n, v)) {
    vec3 w = seen(frame, v);
    float a = alphaOf(m);
    vec3 vh = normalize(vec3(w.xy * a, w.z));
    float z = (1.0 - u.y) * (1.0 + vh.z) - vh.z, s = sqrt(max(1.0 - z * z, 0.0)), phi = 2.0 * PI * u.x;
    vec3 hh = vec3(s * cos(phi), s * sin(phi), z) + vh;
    vec3 h = normalize(vec3(hh.xy * a, max(hh.z, 1e-6)));
    return frame * (2.0 * dot(w, h) * h - w);
  }
  float r = sqrt(u.x), phi = 2.0 * PI * u.y;
  return frame * vec3(r * cos(phi), r * sin(phi), sqrt(max(1.0 - u.x, 0.0)));
}
float brdfPdf(Surface m, vec3 n, vec3 v, vec3 l) {
  float nl = dot(n, l);
  if (nl <= 0.0) return 0.0;
  mat3 frame = frameOf(n);
  vec3 w = seen(frame, v);
  vec3 h = normalize(frame * w + l);
  float a = alphaOf(m), a2 = a * a, share = specularShare(m, n, v);
  float p = ggxD(clamp(dot(n, h), 0.0, 1.0), a) * 0.5 / (w.z + sqrt(w.z * w.z * (1.0 - a2) + a2));
  return share * p + (1.0 - share) * nl / PI;
}
float balance(float a, float b) { return a > 0.0 ? a * a / (a * a + b * b) : 0.0; }

// ---- geometry
struct Hit { vec3 p; vec3 n; Surface m; vec3 away; };

bool meet(vec3 o, vec3 d, out Hit hit) {
  uvec4 face = uvec4(0u);
  vec3 faceNormal = vec3(0.0, 0.0, 1.0), bary = vec3(0.0);
  float side = 1.0, dist = 0.0;
  if (!bvhIntersectFirstHit(bvh, o, d, face, faceNormal, bary, side, dist)) return false;
  hit.p = o + d * dist;
  hit.away = faceNormal;
  vec3 corner[3];
  vec3 at[3];
  for (int k = 0; k < 3; k++) {
    uint i = k == 0 ? face.x : k == 1 ? face.y : face.z;
    at[k] = texelFetch1D(bvh.position, i).xyz;
    corner[k] = texelFetch1D(normals, i).xyz;
  }
  vec3 n = normalize(bary.x * corner[0] + bary.y * corner[1] + bary.z * corner[2]);
  // onto the smooth surface, so that facets do not shade themselves (Hanika 2021)
  vec3 shift = vec3(0.0);
  for (int k = 0; k < 3; k++) {
    vec3 outward = side * corner[k];
    shift -= bary[k] * min(dot(hit.p - at[k], outward), 0.0) * outward;
  }
  float edge = sqrt(max(max(dot(at[1] - at[0], at[1] - at[0]), dot(at[2] - at[1], at[2] - at[1])), dot(at[0] - at[2], at[0] - at[2])));
  hit.p += shift * min(1.0, MAX_SHIFT * edge / max(length(shift), 1e-12));
  vec2 uv = hasUv ? textureSampleBarycoord(uvs, bary, face.xyz).xy : vec2(0.0);
  hit.m.base = baseFactor * (hasBase ? textureLod(baseMap, uv, 0.0).rgb : vec3(1.0));
  vec2 rm = hasRoughMetal ? textureLod(roughMetalMap, uv, 0.0).gb : vec2(1.0);
  hit.m.roughness = roughnessFactor * rm.x;
  hit.m.metallic = metallicFactor * rm.y;
  hit.m.f0 = min(f0 * specularFactor * (hasSpecular ? textureLod(specularMap, uv, 0.0).rgb : vec3(1.0)), vec3(1.0));
  if (white) { hit.m.base = vec3(1.0); hit.m.metallic = 0.0; }
  if (hasNormal && hasTangents) {
    vec3 t3 = normalize(2.0 * textureLod(normalMap, uv, 0.0).rgb - 1.0);
    vec4 t4 = textureSampleBarycoord(tangents, bary, face.xyz);
    vec3 t = t4.xyz - n * dot(n, t4.xyz);
    if (length(t) > 1e-6) {
      t = normalize(t);
      n = normalize(t3.x * t + t3.y * (t4.w < 0.0 ? -1.0 : 1.0) * cross(n, t) + max(t3.z, 1e-3) * n);
    }
  }
  hit.n = side < 0.0 ? -n : n; // both sides of the surface reflect
  return true;
}
bool open(vec3 o, vec3 d, float reach) {
  uvec4 face = uvec4(0u);
  vec3 faceNormal = vec3(0.0), bary = vec3(0.0);
  float side = 1.0, dist = 0.0;
  return !bvhIntersectFirstHit(bvh, o, d, face, faceNormal, bary, side, dist) || dist > reach;
}

vec4 trace(vec3 o, vec3 d) {
  vec3 L = vec3(0.0), beta = vec3(1.0);
  float before_pdf = 1.0;
  bool covered = false;
  for (int depth = 0; depth < maxDepth; depth++) {
    Hit hit;
    if (!meet(o, d, hit)) {
      if (depth > 0) L += beta * balance(before_pdf, lightPdf(d)) * radiance(d);
      break;
    }
    covered = true;
    if (depth + 1 >= maxDepth) break;
    vec3 v = -d;
    vec3 leave = hit.p + hit.away * epsilon;
    if (hasEnvironment) {
      float pdf;
      vec3 l = sampleLight(random3().xy, pdf);
      vec3 f = evaluate(hit.m, hit.n, v, l);
      if (pdf > 0.0 && max(f.x, max(f.y, f.z)) > 0.0 && open(leave, l, INFINITY))
        L += beta * f * radiance(l) / pdf * balance(pdf, brdfPdf(hit.m, hit.n, v, l));
    }
    if (hasPoint) {
      vec3 to = pointPosition - hit.p;
      float far = length(to);
      vec3 f = evaluate(hit.m, hit.n, v, to / far);
      if (max(f.x, max(f.y, f.z)) > 0.0 && open(leave, to / far, far - epsilon)) L += beta * f * pointIntensity / (far * far);
    }
    vec3 l = sampleBrdf(hit.m, hit.n, v, random3());
    float pdf = brdfPdf(hit.m, hit.n, v, l);
    if (!(pdf > 0.0)) break;
    beta *= evaluate(hit.m, hit.n, v, l) / pdf;
    if (!(max(beta.x, max(beta.y, beta.z)) > 0.0)) break;
    o = leave; d = l; before_pdf = pdf;
  }
  bool finite = !(any(isnan(L)) || any(isinf(L)));
  return vec4(finite ? L : vec3(0.0), covered ? 1.0 : 0.0);
}

void main() {
  state = uvec3(uvec2(gl_FragCoord.xy), seed);
  random3();
  vec2 clip = (gl_FragCoord.xy - 0.5 + random3().xy) / size * 2.0 - 1.0;
  vec3 towards = (cameraFromClip * vec4(clip, 1.0, 1.0)).xyz;
  vec3 d = normalize(mat3(assetFromCamera) * towards);
  vec4 value = trace(assetFromCamera[3].xyz, d);
  sum = texelFetch(before, ivec2(gl_FragCoord.xy), 0) + value;
}
`;

// From sums to what is seen: exposure, tone curve, sRGB.
export const displayShader = /* glsl */ `
precision highp float;
uniform sampler2D sums;
uniform float count, exposure;
uniform int tone; // 0 linear, 1 as photographed, 2 PBR neutral
uniform vec3 gain; // of the photo, per channel
uniform vec4 backdrop; // linear; alpha 0 leaves the page through
uniform sampler2D environment;
uniform mat3 lightFromAsset;
uniform mat4 assetFromCamera, cameraFromClip;
uniform bool showLight;
in vec2 vUv;
out vec4 color;

vec3 neutral(vec3 c) { // Khronos PBR Neutral tone mapper, 2024
  const float start = 0.8 - 0.04, desaturation = 0.15;
  float x = min(c.r, min(c.g, c.b));
  c -= x < 0.08 ? x - 6.25 * x * x : 0.04;
  float peak = max(c.r, max(c.g, c.b));
  if (peak < start) return c;
  float d = 1.0 - start, p = 1.0 - d * d / (peak + d - start);
  c *= p / peak;
  return mix(c, vec3(p), 1.0 - 1.0 / (desaturation * (peak - p) + 1.0));
}
vec3 encode(vec3 c) {
  c = clamp(c, 0.0, 1.0);
  return mix(12.92 * c, 1.055 * pow(max(c, vec3(0.0031308)), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
}
void main() {
  vec4 s = texture(sums, vUv) / max(count, 1.0);
  float scale = tone == 1 ? 1.0 : exposure;
  vec3 light = s.rgb * (tone == 1 ? gain : vec3(1.0));
  vec3 behind = backdrop.rgb;
  float cover = backdrop.a;
  if (showLight) {
    vec3 d = lightFromAsset * normalize(mat3(assetFromCamera) * (cameraFromClip * vec4(vUv * 2.0 - 1.0, 1.0, 1.0)).xyz);
    float u = atan(d.x, -d.z) / 6.28318530718;
    behind = textureLod(environment, vec2(u - floor(u), acos(clamp(d.y, -1.0, 1.0)) / 3.14159265359), 0.0).rgb * scale;
    cover = 1.0;
  }
  vec3 c = light * scale + behind * cover * (1.0 - s.a);
  float a = s.a + cover * (1.0 - s.a);
  if (tone == 2) c = neutral(c);
  color = vec4(encode(c), a);
}
`;
