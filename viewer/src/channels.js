// Materials and normals as flat pictures: what the textures hold, without light.
import * as THREE from "three";

const vertexShader = /* glsl */ `
attribute vec4 tangent;
varying vec2 vUv; varying vec3 vN; varying vec4 vT;
void main() { vUv = uv; vN = normal; vT = tangent; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }
`;
const fragmentShader = /* glsl */ `
varying vec2 vUv; varying vec3 vN; varying vec4 vT;
uniform int channel;
uniform sampler2D baseMap, roughMetalMap, normalMap, specularMap;
uniform bool hasBase, hasRoughMetal, hasNormal, hasSpecular, hasTangents;
uniform vec3 baseFactor, specularFactor;
uniform float roughnessFactor, metallicFactor, f0;
vec3 encode(vec3 c) { c = clamp(c, 0.0, 1.0); return mix(12.92 * c, 1.055 * pow(max(c, vec3(0.0031308)), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }
void main() {
  vec2 rm = vec2(roughnessFactor, metallicFactor) * (hasRoughMetal ? texture2D(roughMetalMap, vUv).gb : vec2(1.0));
  vec3 n = normalize(vN);
  if (hasNormal && hasTangents) {
    vec3 m = 2.0 * texture2D(normalMap, vUv).rgb - 1.0, t = normalize(vT.xyz - n * dot(n, vT.xyz));
    n = normalize(m.x * t + m.y * (vT.w < 0.0 ? -1.0 : 1.0) * cross(n, t) + m.z * n);
  }
  if (!gl_FrontFacing) n = -n;
  vec3 c = vec3(0.0);
  if (channel == 0) c = encode(baseFactor * (hasBase ? texture2D(baseMap, vUv).rgb : vec3(1.0)));
  if (channel == 1) c = vec3(rm.x);
  if (channel == 2) c = vec3(rm.y);
  if (channel == 3) c = encode(4.0 * f0 * specularFactor * (hasSpecular ? texture2D(specularMap, vUv).rgb : vec3(1.0))); // F0, times 4 to be seen
  if (channel == 4) c = 0.5 + 0.5 * n;
  gl_FragColor = vec4(c, 1.0);
}
`;
export const CHANNELS = ["albedo", "roughness", "metallic", "specular", "normal"];

// uniforms: those of the tracer, which hold the same maps and factors.
export function channelMaterial(uniforms) {
  const names = ["baseMap", "roughMetalMap", "normalMap", "specularMap", "hasBase", "hasRoughMetal", "hasNormal", "hasSpecular", "hasTangents",
    "baseFactor", "specularFactor", "roughnessFactor", "metallicFactor", "f0"];
  const u = Object.fromEntries(names.map((n) => [n, uniforms[n]]));
  return new THREE.ShaderMaterial({ vertexShader, fragmentShader, uniforms: { ...u, channel: { value: 0 } }, side: THREE.DoubleSide, toneMapped: false });
}
