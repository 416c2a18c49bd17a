// The capture's cameras in the asset frame, as three cameras and as frusta.
import * as THREE from "three";

export const matrixOf = (rows) => new THREE.Matrix4().set(...rows.flat());

// frame: one entry of cameras.json (OpenGL axes, pixels). assetFromWorld: similarity.
export function photoCamera(frame, assetFromWorld, near, far) {
  const c = new THREE.PerspectiveCamera();
  const pose = new THREE.Matrix4().multiplyMatrices(assetFromWorld, matrixOf(frame.transform_matrix));
  const p = new THREE.Vector3(), q = new THREE.Quaternion(), s = new THREE.Vector3();
  pose.decompose(p, q, s);
  c.position.copy(p);
  c.quaternion.copy(q);
  c.updateMatrixWorld(true);
  const { w, h, fl_x, fl_y = fl_x, cx = w / 2, cy = h / 2 } = frame;
  c.projectionMatrix.makePerspective((-cx * near) / fl_x, ((w - cx) * near) / fl_x, (cy * near) / fl_y, (-(h - cy) * near) / fl_y, near, far);
  c.projectionMatrixInverse.copy(c.projectionMatrix).invert();
  return c;
}

// Line segments of all frusta; `length`: of their axes, in asset units.
export function frusta(cameras, length) {
  const points = [], colors = [];
  const corner = new THREE.Vector3(), eye = new THREE.Vector3();
  cameras.forEach(({ camera, chosen }) => {
    eye.setFromMatrixPosition(camera.matrixWorld);
    const around = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) => {
      corner.set(x, y, 0.5).applyMatrix4(camera.projectionMatrixInverse);
      corner.multiplyScalar(length / -corner.z).applyMatrix4(camera.matrixWorld);
      return corner.clone();
    });
    around.forEach((p, i) => points.push(eye.clone(), p, p, around[(i + 1) % 4]));
    const tint = chosen ? [1, 0.7, 0.33] : [0.55, 0.62, 0.7];
    for (let i = 0; i < 16; i++) colors.push(...tint);
  });
  const g = new THREE.BufferGeometry().setFromPoints(points);
  g.setAttribute("color", new THREE.Float32BufferAttribute(colors, 3));
  const lines = new THREE.LineSegments(g, new THREE.LineBasicMaterial({ vertexColors: true, toneMapped: false }));
  lines.frustumCulled = false;
  return lines;
}
