// Forward kinematics of arms on one base. Matrices are lists of rows; joints are ordered from base to tip, arm after arm.

const BASE = [[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [0, 0, 0]];

/** Return the points of the links, one list for each arm, from the base on. points: of the joints; tips: of the ends behind the last joints, if any. */
export function armPaths(joints, points, tips = null) {
  const paths = [];
  joints.forEach((joint, place) => {
    if (joint.root || !place) paths.push([BASE[1]]);
    paths.at(-1).push(points[place]);
    if (tips && (place + 1 === joints.length || joints[place + 1].root)) paths.at(-1).push(tips[place]);
  });
  return paths;
}

/** Return the frames of all joints in the base frame at positions q (in the order of the data): [{rotation, origin, axis}, …]. */
export function frames({ order, joints }, q) {
  let [rotation, origin] = BASE;
  return joints.map((joint, place) => {
    if (joint.root) [rotation, origin] = BASE;
    origin = add(origin, times(rotation, joint.translation));
    rotation = product(rotation, joint.rotation);
    const position = q[order[place]];
    if (joint.type === "prismatic") origin = add(origin, times(rotation, scaled(joint.axis, position)));
    else rotation = product(rotation, turn(joint.axis, position));
    return { rotation, origin, axis: times(rotation, joint.axis) };
  });
}

/** Return the centres of mass of the bodies in their joint frames, m, in the order of the data: first moment / mass. */
export function massCentres(inertia) {
  return inertia.bodies.map(({ plausible: { mass, first_moment: moment } }) => moment.map((each) => each / mass));
}

/** Return the shortest rotation that aligns gravity with −z; the identity if gravity is unknown. */
export function gravityAlignment(gravity) {
  const length = Math.hypot(...gravity);
  if (!length) return turn([0, 0, 1], 0);
  const [x, y, z] = gravity.map((each) => each / length);
  const sine = Math.hypot(x, y);
  if (!sine) return turn([1, 0, 0], z < 0 ? 0 : Math.PI);
  return turn([-y / sine, x / sine, 0], Math.atan2(sine, -z)); // about gravity × (0, 0, −1)
}

/** Return the rotation by an angle, rad, about a unit vector (Rodrigues' formula). */
export function turn([x, y, z], angle) {
  const [sin, cos] = [Math.sin(angle), Math.cos(angle)], rest = 1 - cos;
  return [
    [cos + x * x * rest, x * y * rest - z * sin, x * z * rest + y * sin],
    [y * x * rest + z * sin, cos + y * y * rest, y * z * rest - x * sin],
    [z * x * rest - y * sin, z * y * rest + x * sin, cos + z * z * rest],
  ];
}

export function add(a, b) {
  return a.map((each, index) => each + b[index]);
}

export function scaled(a, factor) {
  return a.map((each) => each * factor);
}

/** Multiply a matrix by a vector. */
export function times(matrix, vector) {
  return matrix.map((row) => row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2]);
}

function product(a, b) {
  return a.map((row) => [0, 1, 2].map((column) => row[0] * b[0][column] + row[1] * b[1][column] + row[2] * b[2][column]));
}
