// Progressive path tracing on the GPU: one sample a pixel and call, summed in float targets, in strips where the GPU is slow.
import * as THREE from "three";
import { FullScreenQuad } from "three/addons/postprocessing/Pass.js";
import { FloatVertexAttributeTexture, MeshBVH, MeshBVHUniformStruct, SAH } from "three-mesh-bvh";
import { displayShader, fragmentShader, vertexShader } from "./pathtrace.glsl.js";

const TABLE = 32, MIN_ALPHA = 0.0064;

// Directional albedo of the GGX lobe, see relit.materials.brdf.albedo_table (16 x 16 strata here).
function lobeTable() {
  const out = new Float32Array(TABLE * TABLE), n = 16;
  for (let row = 0; row < TABLE; row++) {
    const a = Math.max((row / (TABLE - 1)) ** 2, MIN_ALPHA), a2 = a * a;
    const lambda = (x) => 0.5 * (Math.sqrt(1 + a2 * (1 / Math.max(x, 1e-6) ** 2 - 1)) - 1);
    for (let col = 0; col < TABLE; col++) {
      const mu = (col + 0.5) / TABLE, sx = Math.sqrt(1 - mu * mu), norm = Math.hypot(sx * a, mu);
      const vx = (sx * a) / norm, vz = mu / norm, lm = lambda(mu);
      let total = 0;
      for (let i = 0; i < n; i++)
        for (let j = 0; j < n; j++) {
          const phi = (2 * Math.PI * (i + 0.5)) / n, z = (1 - (j + 0.5) / n) * (1 + vz) - vz, s = Math.sqrt(Math.max(1 - z * z, 0));
          let hx = (s * Math.cos(phi) + vx) * a, hy = s * Math.sin(phi) * a, hz = z + vz;
          const k = 1 / Math.hypot(hx, hy, hz);
          hx *= k; hz *= k;
          const nl = 2 * (sx * hx + mu * hz) * hz - mu;
          if (nl > 0) total += (1 + lm) / (1 + lm + lambda(nl));
        }
      out[row * TABLE + col] = total / (n * n);
    }
  }
  const t = new THREE.DataTexture(out, TABLE, TABLE, THREE.RedFormat, THREE.FloatType);
  t.needsUpdate = true;
  return t;
}

const attribute = (a) => {
  const t = new FloatVertexAttributeTexture();
  t.updateFrom(a);
  return t;
};

export class Tracer {
  // geometry: in the asset frame, about 1 large (the ray caster's tolerance is the length 1e-5). material: MeshStandardMaterial or MeshPhysicalMaterial of the glTF loader.
  constructor(renderer, geometry, material) {
    this.renderer = renderer;
    this.usable = renderer.extensions.has("EXT_color_buffer_float") && renderer.extensions.has("OES_texture_float_linear");
    const bvh = new MeshBVH(geometry, { strategy: SAH, maxLeafSize: 4 });
    const struct = new MeshBVHUniformStruct();
    struct.updateFrom(bvh);
    const g = geometry.attributes, m = material, blank = new THREE.Texture();
    const ior = m.ior ?? 1.5, intensity = m.specularIntensity ?? 1;
    const tint = (m.specularColor ?? new THREE.Color(1, 1, 1)).clone().multiplyScalar(intensity);
    const radius = geometry.boundingSphere?.radius ?? (geometry.computeBoundingSphere(), geometry.boundingSphere.radius);
    this.uniforms = {
      bvh: { value: struct },
      normals: { value: attribute(g.normal) },
      uvs: { value: g.uv ? attribute(g.uv) : blank },
      tangents: { value: g.tangent ? attribute(g.tangent) : blank },
      hasUv: { value: !!g.uv }, hasTangents: { value: !!g.tangent },
      baseMap: { value: m.map ?? blank }, hasBase: { value: !!m.map }, baseFactor: { value: new THREE.Vector3(m.color.r, m.color.g, m.color.b) },
      roughMetalMap: { value: m.roughnessMap ?? blank }, hasRoughMetal: { value: !!m.roughnessMap },
      roughnessFactor: { value: m.roughness }, metallicFactor: { value: m.metalness },
      normalMap: { value: m.normalMap ?? blank }, hasNormal: { value: !!m.normalMap },
      specularMap: { value: m.specularColorMap ?? blank }, hasSpecular: { value: !!m.specularColorMap },
      specularFactor: { value: new THREE.Vector3(tint.r, tint.g, tint.b) }, f0: { value: ((ior - 1) / (ior + 1)) ** 2 },
      white: { value: false },
      lobeTable: { value: lobeTable() },
      environment: { value: blank }, rowCdf: { value: blank }, cellCdf: { value: blank }, cells: { value: new THREE.Vector2(1, 1) },
      hasEnvironment: { value: false }, hasPoint: { value: false },
      lightFromAsset: { value: new THREE.Matrix3() },
      pointPosition: { value: new THREE.Vector3() }, pointIntensity: { value: new THREE.Vector3() },
      assetFromCamera: { value: new THREE.Matrix4() }, cameraFromClip: { value: new THREE.Matrix4() },
      size: { value: new THREE.Vector2() }, seed: { value: 0 }, maxDepth: { value: 6 }, epsilon: { value: 5e-5 * Math.max(radius, 1) },
      before: { value: null },
    };
    const full = (fragment, uniforms) => new FullScreenQuad(new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader, fragmentShader: fragment, uniforms, depthTest: false, depthWrite: false, blending: THREE.NoBlending,
    }));
    this.tracing = full(fragmentShader, this.uniforms);
    const u = this.uniforms;
    this.showing = {
      sums: { value: null }, count: { value: 0 }, exposure: { value: 1 }, tone: { value: 0 }, gain: { value: new THREE.Vector3(1, 1, 1) },
      backdrop: { value: new THREE.Vector4(0, 0, 0, 1) }, showLight: { value: false },
      environment: u.environment, lightFromAsset: u.lightFromAsset, assetFromCamera: u.assetFromCamera, cameraFromClip: u.cameraFromClip,
    };
    this.display = full(displayShader, this.showing);
    this.targets = [];
    this.count = 0;
    this.strip = 0;
    this.strips = 1;
  }

  setLight(light, lightFromAsset) {
    const u = this.uniforms;
    u.hasEnvironment.value = !!light;
    if (light) {
      u.environment.value = light.texture; u.rowCdf.value = light.rowCdf; u.cellCdf.value = light.cellCdf;
      u.cells.value.set(...light.cells);
    }
    u.lightFromAsset.value.copy(lightFromAsset);
    this.reset();
  }

  resize(width, height) {
    if (this.targets.length && this.targets[0].width === width && this.targets[0].height === height) return;
    this.targets.forEach((t) => t.dispose());
    const make = () => new THREE.WebGLRenderTarget(width, height, {
      type: THREE.FloatType, format: THREE.RGBAFormat, minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter, depthBuffer: false,
    });
    this.targets = [make(), make()];
    this.uniforms.size.value.set(width, height);
    this.reset();
  }

  reset() { this.count = 0; this.strip = 0; this.dirty = true; }

  // One strip of one sample. camera: a three camera in the asset frame.
  step(camera) {
    const [a, b] = this.targets, r = this.renderer, u = this.uniforms;
    if (this.dirty) {
      u.assetFromCamera.value.copy(camera.matrixWorld);
      u.cameraFromClip.value.copy(camera.projectionMatrixInverse);
      a.scissorTest = false;
      r.setRenderTarget(a); r.setClearColor(0x000000, 0); r.clear();
      this.dirty = false;
    }
    u.seed.value = this.count * 7919 + 17;
    u.before.value = a.texture;
    const low = Math.floor((a.height * this.strip) / this.strips), high = Math.floor((a.height * (this.strip + 1)) / this.strips);
    b.scissorTest = true;
    b.scissor.set(0, low, b.width, high - low);
    r.setRenderTarget(b);
    const keep = r.autoClear;
    r.autoClear = false;
    this.tracing.render(r);
    r.autoClear = keep;
    r.setRenderTarget(null);
    if (++this.strip >= this.strips) {
      this.strip = 0;
      this.targets = [b, a];
      this.count++;
    }
  }

  // Draw what has been gathered to the screen (or `target`).
  show(target = null) {
    this.showing.sums.value = this.targets[0].texture;
    this.showing.count.value = this.count;
    this.renderer.setRenderTarget(target);
    this.display.render(this.renderer);
    this.renderer.setRenderTarget(null);
  }

  // Means as RGBA float32, row 0 at the bottom.
  read() {
    const t = this.targets[0], out = new Float32Array(t.width * t.height * 4);
    this.renderer.readRenderTargetPixels(t, 0, 0, t.width, t.height, out);
    return out.map((v) => v / Math.max(this.count, 1));
  }
}
