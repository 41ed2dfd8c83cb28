// Camera of the 3-D drawing: it looks across the plane of the arm, from so far that all of the scene is in the frame.

const FIELD = Math.PI / 8; // half of the vertical angle of Plotly's camera
const TURN = 0.35, RISE = 0.25; // rotation of the eye away from the normal of the plane, so that depth is visible, rad
const ROOM = 1.06, LABELS = 1.12; // spare distance, for the border and for the labels of the axes
const ROUNDS = 6; // of centring
const STEEP = 0.75; // sine of the elevation above which the arm lies flat and is seen from above

/** Return the unit vector to the eye: across the plane of the points, along the direction of their least spread. */
export function acrossPlane(points) {
  const mean = [0, 1, 2].map((k) => points.reduce((sum, point) => sum + point[k], 0) / points.length);
  const spread = [0, 1, 2].map((i) => [0, 1, 2].map((k) => points.reduce((sum, point) => sum + (point[i] - mean[i]) * (point[k] - mean[k]), 0)));
  let [x, y, z] = leastDirection(spread);
  if (y > 0 || (y === 0 && x < 0)) [x, y, z] = [-x, -y, -z]; // from the front
  const flat = Math.abs(z) > STEEP || Math.hypot(x, y) < 1e-6;
  const azimuth = flat ? -Math.PI / 3 : Math.atan2(y, x) + TURN;
  const elevation = flat ? Math.PI / 3 : Math.max(Math.asin(Math.min(Math.abs(z), 1)), RISE);
  return [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
}

/** Return Plotly's camera {eye, center} that shows a box of these sides, around the origin, in the middle of a frame width / height. */
export function cameraFor(direction, sides, ratio, labels) {
  const [x, y] = direction, flat = Math.hypot(x, y);
  const right = [-y / flat, x / flat, 0], up = cross(direction, right);
  const tan = Math.tan(FIELD), ends = [-0.5, 0.5];
  const corners = ends.flatMap((i) => ends.flatMap((j) => ends.map((k) => [i * sides[0], j * sides[1], k * sides[2]])));
  let center = [0, 0, 0], distance = 0;
  for (let round = 0; round < ROUNDS; round += 1) {
    const seen = corners.map((corner) => [right, up, direction].map((each) => dot(corner, each) - dot(center, each)));
    distance = Math.max(...seen.map(([side, height, depth]) => Math.max(Math.abs(side) / (tan * ratio), Math.abs(height) / tan) + depth));
    if (round === ROUNDS - 1) break;
    const heights = seen.map(([, height, depth]) => height / (distance - depth));
    const shift = (distance * (Math.max(...heights) + Math.min(...heights))) / 2; // near corners appear larger
    center = center.map((each, k) => each + shift * up[k]);
  }
  distance *= labels ? LABELS : ROOM;
  const point = ([px, py, pz]) => ({ x: px, y: py, z: pz });
  return { center: point(center), eye: point(center.map((each, k) => each + distance * direction[k])) };
}

/** Return the eigenvector of the smallest eigenvalue of a symmetric matrix, by Jacobi rotations. */
function leastDirection(matrix) {
  const a = matrix.map((row) => [...row]), vectors = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  for (let round = 0; round < 30; round += 1) {
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]]) {
      const angle = 0.5 * Math.atan2(2 * a[p][q], a[q][q] - a[p][p]), [cos, sin] = [Math.cos(angle), Math.sin(angle)];
      const rotate = (one, other) => [cos * one - sin * other, sin * one + cos * other];
      for (let k = 0; k < 3; k += 1) [a[k][p], a[k][q]] = rotate(a[k][p], a[k][q]);
      for (let k = 0; k < 3; k += 1) [a[p][k], a[q][k]] = rotate(a[p][k], a[q][k]);
      for (let k = 0; k < 3; k += 1) [vectors[k][p], vectors[k][q]] = rotate(vectors[k][p], vectors[k][q]);
    }
  }
  const least = [0, 1, 2].reduce((best, k) => (a[k][k] < a[best][best] ? k : best), 0);
  return vectors.map((row) => row[least]);
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

function cross([a, b, c], [x, y, z]) {
  return [b * z - c * y, c * x - a * z, a * y - b * x];
}
