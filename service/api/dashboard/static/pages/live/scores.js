// How far rows were from their predictions: innovations in standard deviations of a measurement, and what is left unexplained.

const LATELY_S = 5;
const NOW_S = 0.5;
const STAYS = 1.25; // times as large another joint's innovation has to be, to take the place of the largest

/** (measured − predicted) / standard deviation of a measurement of one joint; null where either is not known. */
export function score(row, joint) {
  const { tau, mean, std } = row;
  return tau[joint] === null || mean[joint] === null ? null : (tau[joint] - mean[joint]) / std[joint];
}

/** The largest innovation of each joint within the last seconds, in standard deviations; 0 where nothing was predicted. */
export function lately(rows, joints) {
  const worst = joints.map(() => 0);
  for (const row of rows) {
    if (row.x < -LATELY_S) continue;
    joints.forEach((_name, joint) => (worst[joint] = Math.max(worst[joint], Math.abs(score(row, joint) ?? 0))));
  }
  return worst;
}

/** The joint with the largest of these numbers; the one before, if not null, stays unless another is clearly larger. */
export function largest(scores, before) {
  const top = scores.indexOf(Math.max(...scores));
  return before === null || scores[top] > STAYS * scores[before] ? top : before;
}

/**
 * Torque of each joint that the model does not explain, mean of the last half second: [{mean, std}, …]. std: of one
 * measurement, which is what a torque from outside that goes on has to exceed. null: nothing was measured.
 */
export function unexplained(rows, joints) {
  return joints.map((_name, joint) => {
    const now = rows.filter((row) => row.x >= -NOW_S && row.tau[joint] !== null && row.mean[joint] !== null);
    if (!now.length) return null;
    const average = (value) => now.reduce((sum, row) => sum + value(row), 0) / now.length;
    return { mean: average((row) => row.tau[joint] - row.mean[joint]), std: average((row) => row.std[joint]) };
  });
}
