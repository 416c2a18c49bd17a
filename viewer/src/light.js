// Lat-long maps: reading .hdr and .exr, and the distribution that the path tracer draws directions from.
import * as THREE from "three";
import { EXRLoader } from "three/addons/loaders/EXRLoader.js";
import { HDRLoader } from "three/addons/loaders/HDRLoader.js";

const MOST_TEXELS = 1 << 26;
const MOST_CELLS = 256; // columns of the distribution

function floatTexture(data, width, height, format, filter) {
  const t = new THREE.DataTexture(data, width, height, format, THREE.FloatType);
  t.minFilter = t.magFilter = filter;
  t.wrapS = THREE.RepeatWrapping;
  t.wrapT = THREE.ClampToEdgeWrapping;
  t.generateMipmaps = false;
  t.needsUpdate = true;
  return t;
}

// three's EXR reader does not stop at the end of a damaged file: walk the header before it does.
function checkExr(bytes) {
  const view = new DataView(bytes), damaged = () => new Error("it is no EXR file, or a damaged one");
  if (bytes.byteLength < 16 || view.getUint32(0, true) !== 20000630) throw damaged();
  let at = 8;
  const text = () => {
    const from = at;
    while (at < bytes.byteLength && view.getUint8(at) !== 0) at++;
    if (at >= bytes.byteLength || at - from > 255) throw damaged();
    return String.fromCharCode(...new Uint8Array(bytes, from, at++ - from));
  };
  for (let window = null; ; ) {
    const name = text();
    if (!name) {
      if (!window) throw damaged();
      const [w, h] = [window[2] - window[0] + 1, window[3] - window[1] + 1];
      if (w < 1 || h < 1 || w * h > MOST_TEXELS) throw new Error(`its size ${w} x ${h} makes no sense for a light`);
      return;
    }
    text();
    const size = at + 4 <= bytes.byteLength ? view.getInt32(at, true) : -1;
    if (size < 0 || at + 4 + size > bytes.byteLength) throw damaged();
    if (name === "dataWindow" && size === 16) window = [0, 4, 8, 12].map((k) => view.getInt32(at + 4 + k, true));
    at += 4 + size;
  }
}

// bytes: ArrayBuffer; name: decides the format. Row 0 of the result is the top (+Y).
export function decodeLight(bytes, name) {
  const exr = /\.exr$/i.test(name);
  if (exr) checkExr(bytes);
  const loader = exr ? new EXRLoader() : new HDRLoader();
  loader.type = THREE.FloatType;
  const image = loader.parse(bytes);
  const { width, height, data } = image;
  const channels = Math.round(data.length / (width * height));
  const out = new Float32Array(width * height * 4);
  for (let y = 0; y < height; y++) {
    const from = exr ? height - 1 - y : y; // three's EXR rows begin at the bottom
    for (let x = 0; x < width; x++)
      for (let c = 0; c < 3; c++) {
        const v = data[(from * width + x) * channels + Math.min(c, channels - 1)];
        out[(y * width + x) * 4 + c] = Number.isFinite(v) ? Math.max(v, 0) : 0;
      }
  }
  return new Light(out, width, height, name);
}

export class Light {
  // data: RGBA float32, row 0 at the top, in Relit's axes.
  constructor(data, width, height, name) {
    Object.assign(this, { data, width, height, name });
    for (let i = 3; i < data.length; i += 4) data[i] = 1;
    this.texture = floatTexture(data, width, height, THREE.RGBAFormat, THREE.LinearFilter);
    this.distribute();
  }

  distribute() {
    const w = Math.min(this.width, MOST_CELLS), h = Math.max(1, Math.min(this.height, MOST_CELLS / 2));
    const mean = new Float64Array(w * h), count = new Float64Array(w * h);
    for (let y = 0; y < this.height; y++)
      for (let x = 0; x < this.width; x++) {
        const i = (y * this.width + x) * 4, k = Math.floor((y * h) / this.height) * w + Math.floor((x * w) / this.width);
        mean[k] += 0.2126 * this.data[i] + 0.7152 * this.data[i + 1] + 0.0722 * this.data[i + 2];
        count[k]++;
      }
    let all = 0;
    for (let k = 0; k < mean.length; k++) all += mean[k] /= Math.max(count[k], 1);
    const floor = 0.02 * (all / mean.length) + 1e-9; // every direction can be drawn: texels are interpolated
    const rows = new Float32Array(h), cells = new Float32Array(w * h);
    let total = 0;
    for (let y = 0; y < h; y++) {
      let run = 0;
      for (let x = 0; x < w; x++) {
        let around = 0; // the interpolation reaches into the neighbours
        for (let dx = -1; dx <= 1; dx++)
          for (let dy = -1; dy <= 1; dy++) around += mean[Math.min(Math.max(y + dy, 0), h - 1) * w + ((x + dx + w) % w)];
        run += (0.5 * mean[y * w + x] + 0.5 * (around / 9) + floor) * Math.sin((Math.PI * (y + 0.5)) / h);
        cells[y * w + x] = run;
      }
      for (let x = 0; x < w; x++) cells[y * w + x] /= run;
      cells[y * w + w - 1] = 1;
      rows[y] = total += run;
    }
    for (let y = 0; y < h; y++) rows[y] /= total;
    rows[h - 1] = 1;
    this.cells = [w, h];
    this.rowCdf = floatTexture(rows, h, 1, THREE.RedFormat, THREE.NearestFilter);
    this.cellCdf = floatTexture(cells, w, h, THREE.RedFormat, THREE.NearestFilter);
  }

  // For three's own image-based light, which has u(+X) = .5 where Relit has .25: a roll by a quarter, and rows from the bottom.
  equirect() {
    const { width, height } = this, out = new Float32Array(this.data.length), quarter = Math.round(width / 4);
    for (let y = 0; y < height; y++)
      for (let x = 0; x < width; x++)
        for (let c = 0; c < 4; c++)
          out[((height - 1 - y) * width + ((x + quarter) % width)) * 4 + c] = Math.min(this.data[(y * width + x) * 4 + c], 6e4);
    const t = floatTexture(out, width, height, THREE.RGBAFormat, THREE.LinearFilter);
    t.mapping = THREE.EquirectangularReflectionMapping;
    return t;
  }

  dispose() {
    for (const t of [this.texture, this.rowCdf, this.cellCdf]) t.dispose();
  }
}

// A light for assets that came without one: an even sky over a darker ground.
export function plainLight() {
  const w = 64, h = 32, data = new Float32Array(w * h * 4);
  for (let y = 0; y < h; y++) for (let x = 0; x < w; x++) data.fill(y < h / 2 ? 1.0 - y / h : 0.25, (y * w + x) * 4, (y * w + x) * 4 + 3);
  return new Light(data, w, h, "plain");
}
