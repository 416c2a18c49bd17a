// The picture: object, light, camera, and which of three ways draws it (path traced, fast, channel).
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { mergeGeometries } from "three/addons/utils/BufferGeometryUtils.js";
import { frusta, matrixOf, photoCamera } from "./cameras.js";
import { CHANNELS, channelMaterial } from "./channels.js";
import { Tracer } from "./tracer.js";

const SETTLE = 180; // ms after the last motion before path tracing begins
const TONES = { linear: 0, photo: 1, neutral: 2 };
const FIELD = 35; // degrees
const MATCHED = 8; // samples after which a photo's exposure and white balance are read off

const rotationOf = (m) => new THREE.Matrix3().setFromMatrix4(new THREE.Matrix4().extractRotation(m));

export class Viewer {
  constructor(canvas, stage) {
    this.canvas = canvas;
    this.stage = stage;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.toneMapping = THREE.LinearToneMapping;
    this.state = { view: "shaded", tone: "linear", exposure: 1, rotate: 0, traced: true, showLight: false, frusta: false, samples: 512, photo: -1, depth: 6 };
    this.scene = new THREE.Scene();
    this.lines = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(FIELD, 1, 0.01, 100);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.addEventListener("change", () => this.moved());
    this.gains = new Map(); // photo -> red, green, blue: its exposure and white balance against the render
    this.lastMotion = -Infinity;
    this.lastFrame = 0;
    this.onProgress = () => {};
    new ResizeObserver(() => this.layout()).observe(stage);
  }

  async load(manifest, glb) {
    const gltf = await new GLTFLoader().parseAsync(glb, "");
    gltf.scene.updateMatrixWorld(true);
    const parts = [];
    let material = null;
    gltf.scene.traverse((o) => {
      if (!o.isMesh) return;
      const g = o.geometry.clone();
      g.applyMatrix4(o.matrixWorld);
      for (const name of Object.keys(g.attributes)) if (!["position", "normal", "uv", "tangent"].includes(name)) g.deleteAttribute(name);
      parts.push(g);
      material ??= o.material;
    });
    if (!parts.length) throw new Error("the model holds no triangles");
    this.one = parts.length > 1 ? mergeGeometries(parts) : parts[0];
    this.material = material;
    this.worldFromAsset = matrixOf(manifest.asset.world_from_asset);
    // everything is drawn at the scale at which the object has radius 1: the ray caster's tolerance is a length
    this.one.computeBoundingSphere();
    const { center: c, radius } = this.one.boundingSphere, k = 1 / Math.max(radius, 1e-30);
    const unit = new THREE.Matrix4().makeScale(k, k, k).multiply(new THREE.Matrix4().makeTranslation(-c.x, -c.y, -c.z));
    this.one.applyMatrix4(unit);
    this.assetFromWorld = unit.clone().multiply(this.worldFromAsset.clone().invert());
    const back = unit.clone().invert();
    this.instances = (manifest.asset.instances ?? []).map((m) => this.assetFromWorld.clone().multiply(matrixOf(m)).multiply(back));
    this.frames = manifest.cameras;
    this.setGeometry(false);
  }

  // all: every instance of a duplicates capture, else the one object.
  setGeometry(all) {
    const copies = all && this.instances.length ? this.instances : [new THREE.Matrix4()];
    const moved = copies.map((m) => this.one.clone().applyMatrix4(m));
    const geometry = moved.length > 1 ? mergeGeometries(moved) : moved[0];
    geometry.computeBoundingSphere();
    this.ball = geometry.boundingSphere;
    this.tracer = new Tracer(this.renderer, geometry, this.material); // may reorder the triangles
    this.state.traced &&= this.tracer.usable;
    this.channel = channelMaterial(this.tracer.uniforms);
    this.scene.clear();
    this.mesh = new THREE.Mesh(geometry, this.material);
    this.scene.add(this.mesh);
    const near = this.ball.radius * 0.01, far = this.ball.radius * 1000;
    this.photos = this.frames.map((f) => photoCamera(f, this.assetFromWorld, near, far));
    Object.assign(this.camera, { near, far });
    this.home();
    if (this.light) this.setLight(this.light, this.own);
    this.layout();
  }

  home() {
    const c = this.ball.center, distance = (1.08 * this.ball.radius) / Math.sin((FIELD / 2) * (Math.PI / 180));
    this.camera.position.set(c.x, c.y + 0.34 * distance, c.z + 0.94 * distance);
    this.controls.target.copy(c);
    this.controls.update();
  }

  // own: the light was recovered with the asset and stands in the frame of its cameras; else it is upright in the asset's frame.
  setLight(light, own) {
    Object.assign(this, { light, own });
    this.environment?.dispose();
    const pmrem = new THREE.PMREMGenerator(this.renderer), equirect = light.equirect();
    this.environment = pmrem.fromEquirectangular(equirect).texture;
    equirect.dispose();
    pmrem.dispose();
    this.scene.environment = this.environment;
    this.place();
  }

  // A small lamp at the camera, as `lights/flash.json` describes it, or null.
  setFlash(flash) { this.flash = flash; this.place(); }

  place() {
    const turn = new THREE.Matrix4().makeRotationY(-this.state.rotate * (Math.PI / 180));
    const m = this.own ? new THREE.Matrix4().extractRotation(this.worldFromAsset).multiply(turn) : turn;
    this.tracer.setLight(this.flash ? null : this.light, rotationOf(m));
    this.scene.environmentRotation.setFromRotationMatrix(m.clone().transpose()); // three turns the map, not the direction
    this.placeFlash();
    this.restart();
  }

  placeFlash() {
    const u = this.tracer.uniforms;
    u.hasPoint.value = !!this.flash;
    if (!this.flash) return;
    const camera = this.active(), s = Math.cbrt(this.assetFromWorld.determinant());
    const [x, y, z] = this.flash.offset; // OpenCV camera axes, units of the cameras
    u.pointPosition.value.set(x, -y, -z).multiplyScalar(s).applyMatrix4(camera.matrixWorld);
    u.pointIntensity.value.fromArray(this.flash.intensity).multiplyScalar(s * s);
  }

  active() { return this.state.photo >= 0 ? this.photos[this.state.photo] : this.camera; }

  choosePhoto(index) {
    this.state.photo = index;
    this.controls.enabled = index < 0;
    this.layout();
    this.place();
  }

  set(key, value) {
    this.state[key] = value;
    if (key === "rotate") this.place();
    else if (key === "frusta" || key === "exposure" || key === "tone" || key === "showLight") this.redraw = true;
    else this.restart();
  }

  layout() {
    const box = this.stage.getBoundingClientRect(), ratio = Math.min(window.devicePixelRatio || 1, 2);
    let [w, h] = [Math.max(box.width, 1), Math.max(box.height, 1)];
    if (this.state.photo >= 0) {
      const f = this.frames[this.state.photo], k = Math.min(w / f.w, h / f.h);
      [w, h] = [f.w * k, f.h * k];
    }
    this.resize(Math.max(1, Math.round(w)), Math.max(1, Math.round(h)), ratio);
    this.onLayout?.();
  }

  resize(width, height, ratio) {
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.tracer?.resize(this.canvas.width, this.canvas.height);
    this.restart();
  }

  moved() { this.lastMotion = performance.now(); if (this.flash) this.placeFlash(); this.restart(); }
  restart() { this.tracer?.reset(); this.redraw = true; }

  get tracing() {
    return this.state.traced && (this.state.view === "shaded" || this.state.view === "shading") && performance.now() - this.lastMotion > SETTLE;
  }

  frame(now) {
    if (!this.tracer || this.busy) return;
    const camera = this.active();
    camera.updateMatrixWorld();
    if (this.tracing) {
      const t = this.tracer;
      if (t.count < this.state.samples) {
        const passed = now - this.lastFrame;
        if (t.strip === 0 && passed > 150) t.strips = Math.min(t.strips * 2, 32); // a slow GPU: less at a time, so that the page stays quick
        else if (t.strip === 0 && passed < 25 && t.strips > 1) t.strips /= 2;
        t.uniforms.white.value = this.state.view === "shading";
        t.uniforms.maxDepth.value = this.state.depth;
        t.step(camera);
        this.redraw = true;
      }
      if (this.redraw && t.count > 0) this.showTraced();
      else if (this.redraw) this.showFast(camera);
    } else if (this.redraw) this.showFast(camera);
    this.lastFrame = now;
    if (this.tracing && this.tracer.strip === 0 && this.tracer.count === MATCHED) this.onMatch?.();
    this.onProgress(this.tracing ? this.tracer.count : -1);
  }

  showTraced(target = null) {
    const s = this.tracer.showing;
    s.gain.value.fromArray(this.gains.get(this.state.photo) ?? [1, 1, 1]);
    s.exposure.value = this.state.exposure;
    s.tone.value = TONES[this.state.tone];
    s.showLight.value = this.state.showLight && !this.flash;
    s.backdrop.value.set(0, 0, 0, target || this.state.photo >= 0 ? 1 : 0);
    this.tracer.show(target);
    this.redraw = false;
    if (!target) this.drawLines();
  }

  showFast(camera) {
    const channel = CHANNELS.indexOf(this.state.view), r = this.renderer;
    r.setRenderTarget(null);
    r.setClearColor(0x000000, this.state.photo >= 0 ? 1 : 0);
    this.channel.uniforms.channel.value = Math.max(channel, 0);
    this.mesh.material = channel >= 0 ? this.channel : this.state.view === "shading" ? this.whiteMaterial() : this.material;
    r.toneMapping = this.state.tone === "neutral" ? THREE.NeutralToneMapping : THREE.LinearToneMapping;
    r.toneMappingExposure = this.state.tone === "photo" ? 1 : this.state.exposure;
    this.scene.background = this.state.showLight && channel < 0 ? this.environment : null;
    this.scene.backgroundRotation.copy(this.scene.environmentRotation);
    r.render(this.scene, camera);
    this.redraw = false;
    this.drawLines();
  }

  whiteMaterial() {
    return (this.white ??= new THREE.MeshStandardMaterial({ color: 0xffffff, roughness: 1, metalness: 0, side: THREE.DoubleSide }));
  }

  drawLines() {
    if (!this.state.frusta || this.state.photo >= 0) return;
    const distance = Math.min(...this.photos.map((c) => c.position.distanceTo(this.ball.center)), 1e9);
    this.lines.clear();
    const only = (this.shadow ??= new THREE.MeshBasicMaterial({ colorWrite: false }));
    this.lines.add(new THREE.Mesh(this.mesh.geometry, only), frusta(this.photos.map((camera, i) => ({ camera, chosen: i === this.lastPhoto })), 0.12 * distance));
    const r = this.renderer, keep = r.autoClear;
    r.autoClear = false;
    r.clearDepth();
    r.render(this.lines, this.camera);
    r.autoClear = keep;
  }

  // The photo whose camera stands under a point of the canvas (CSS pixels), or -1.
  photoAt(x, y) {
    let best = -1, least = 14;
    const p = new THREE.Vector3();
    this.photos.forEach((c, i) => {
      p.copy(c.position).project(this.camera);
      const d = Math.hypot(((p.x + 1) / 2) * this.canvas.clientWidth - x, ((1 - p.y) / 2) * this.canvas.clientHeight - y);
      if (p.z < 1 && d < least) [best, least] = [i, d];
    });
    return best;
  }

  // Exposure and white balance of the chosen photo (an image element) against the render from its camera: what `as photographed` shows.
  matchPhoto(image) {
    const t = this.tracer.targets[0], w = t.width, h = t.height, mean = this.tracer.read();
    const context = Object.assign(document.createElement("canvas"), { width: w, height: h }).getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0, w, h);
    const codes = context.getImageData(0, 0, w, h).data, photo = [0, 0, 0], render = [0, 0, 0];
    const linear = (c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
    const k = Math.max(1, Math.round((3 * w) / image.naturalWidth)); // off the rim, where pixels of the photo hold background as well
    const covered = (x, y) => x >= 0 && y >= 0 && x < w && y < h && mean[4 * ((h - 1 - y) * w + x) + 3] > 0.99;
    for (let y = 0; y < h; y++)
      for (let x = 0; x < w; x++) {
        const p = 4 * (y * w + x), r = 4 * ((h - 1 - y) * w + x);
        if (!(covered(x - k, y) && covered(x + k, y) && covered(x, y - k) && covered(x, y + k) && covered(x, y)) || Math.max(codes[p], codes[p + 1], codes[p + 2]) > 250) continue; // clipped pixels say nothing
        for (let c = 0; c < 3; c++) { photo[c] += linear(codes[p + c] / 255); render[c] += mean[r + c]; }
      }
    const gain = photo.map((v, c) => (render[c] > 0 && v > 0 ? Math.min(Math.max(v / render[c], 0.125), 8) : 1));
    this.gains.set(this.state.photo, gain);
    this.redraw = true;
    return gain;
  }

  // For tests and scripts: `count` samples at width x height from a photo's camera; linear RGBA means, row 0 at the top.
  async linear(photo, width, height, count) {
    this.busy = true;
    this.state.photo = photo;
    this.resize(width, height, 1);
    this.place();
    const camera = this.active(), t = this.tracer;
    camera.updateMatrixWorld();
    t.strips = 1;
    t.uniforms.maxDepth.value = this.state.depth;
    t.uniforms.white.value = this.state.view === "shading";
    while (t.count < count) {
      t.step(camera);
      if (t.count % 8 === 0) await new Promise((done) => setTimeout(done));
    }
    this.busy = false;
    const rows = t.read(), out = [];
    for (let y = height - 1; y >= 0; y--) out.push(...rows.subarray(y * width * 4, (y + 1) * width * 4));
    return out;
  }
}
