// Innovations in standard deviations of a measurement, and external torque.

const RECENT_S = 5;
const MEAN_S = 0.5;
const HYSTERESIS = 1.25; // factor by which another joint's innovation must exceed that of the current one

/** Return the innovation of a joint: (measured − predicted) / standard deviation of a measurement; null if unknown. */
export function innovationOf(row, joint) {
  const { tau, mean, std } = row;
  return tau[joint] === null || mean[joint] === null ? null : (tau[joint] - mean[joint]) / std[joint];
}

/** Return the largest recent innovation of each joint, in standard deviations; 0 if nothing was predicted. */
export function recentInnovations(rows, joints) {
  const worst = joints.map(() => 0);
  for (const row of rows) {
    if (row.x < -RECENT_S) continue;
    joints.forEach((_name, joint) => (worst[joint] = Math.max(worst[joint], Math.abs(innovationOf(row, joint) ?? 0))));
  }
  return worst;
}

/** Return the joint with the largest score; keep the previous joint unless another one is clearly larger. */
export function largestJoint(scores, before) {
  const top = scores.indexOf(Math.max(...scores));
  return before === null || scores[top] > HYSTERESIS * scores[before] ? top : before;
}

/**
 * Return the external torque of each joint, mean of the last half second: [{mean, std}, …]. std: standard deviation of
 * one measurement; null entries: no measurement.
 */
export function externalTorque(rows, joints) {
  return joints.map((_name, joint) => {
    const now = rows.filter((row) => row.x >= -MEAN_S && row.tau[joint] !== null && row.mean[joint] !== null);
    if (!now.length) return null;
    const average = (value) => now.reduce((sum, row) => sum + value(row), 0) / now.length;
    return { mean: average((row) => row.tau[joint] - row.mean[joint]), std: average((row) => row.std[joint]) };
  });
}
