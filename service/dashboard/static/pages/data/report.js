// The report of a data set as cards: what to do first, then what was found.

import { h } from "../../dom.js";
import { count, counted, number, percent, seconds, shortNames, when } from "../../format.js";
import { badge, card, facts, table } from "../../ui.js";
import { prose, sentences, warned } from "./prose.js";

const CONVENTIONS = { gravity_included: "gravity included", gravity_compensated: "gravity compensated: added to what holds the arm" };
const PARTIAL = "This report was made by an older release of LIPServe, without advice and further figures.";

/** Advice, warnings and the facts. */
export function summary(dataset) {
  const { report } = dataset;
  const judged = report.excitation !== null;
  return [
    warned(report.warnings),
    card(
      "What to record next, or to correct",
      report.advice.length ? sentences(report.advice) : h("p", {}, judged ? "Nothing: the recording is good to train on." : PARTIAL),
    ),
    card(
      "In short",
      facts([
        ["Samples", kept(report)],
        ["Length", report.timing?.duration_s == null ? "not known" : seconds(report.timing.duration_s)],
        ["Rate", report.rate_hz === null ? "not known" : `${number(report.rate_hz, 4)} Hz`],
        ["Episodes", count(report.episodes)],
        ["Torque", CONVENTIONS[dataset.torque_convention] ?? dataset.torque_convention],
        ["Robot", report.robot ?? "not said"],
        ["Derived, not recorded", report.derived.length ? report.derived.join(", ") : "nothing"],
        ["Uploaded", when(dataset.created_at)],
        ["Id", h("code", {}, dataset.id)],
      ]),
      h("p", {}, h("span", { class: "muted" }, `${counted(dataset.joint_names.length, "joint")}: `), dataset.joint_names.join(", ")),
    ),
  ];
}

function kept(report) {
  return report.rows === report.rows_uploaded ? count(report.rows) : `${count(report.rows)} of ${count(report.rows_uploaded)} rows uploaded`;
}

/** The sections, one card each; those that a report lacks are left out. */
export function reportCards(report, joints) {
  return h(
    "div",
    {},
    excitation(report.excitation, joints),
    h(
      "div",
      { class: "grid wide", style: "align-items: start" },
      againstRobot(report.against_robot, joints),
      limits(report.limits, joints),
      noise(report, joints),
      saturation(report.saturation, joints),
      h("div", {}, timing(report), lag(report.lag)),
    ),
    ranges(report, joints),
    preparation(report),
  );
}

const short = (joints) => {
  const names = new Map(shortNames(joints).map((name, index) => [joints[index], name]));
  return { label: "Joint", cell: (row) => names.get(row.joint) ?? row.joint };
};

function excitation(found, joints) {
  if (!found) return null;
  const weight = (name) => (row) => {
    const { verdict, std, value, implausible } = row[name];
    const figure = value == null ? "" : ` ${number(value, 2)}`;
    return [implausible ? badge("implausible", "bad") : badge(verdict), figure, std === null ? "" : ` ±${number(std, 2)}`];
  };
  const whole = found.whole;
  const beside = found.friction_beside === "rigid bodies" ? "the robot's rigid bodies" : "any smooth function of the motion";
  return card(
    "What these data tell",
    table(
      [
        short(joints),
        { label: "Viscous friction", cell: weight("viscous") },
        { label: "Coulomb friction", cell: weight("coulomb") },
        { label: "Constant torque", cell: weight("offset") },
        { label: "Reversals", numeric: true, cell: (row) => count(row.reversals) },
        { label: "Still", numeric: true, cell: (row) => percent(row.still, 0) },
        { label: "Forwards / backwards", numeric: true, cell: (row) => `${percent(row.forwards, 0)} / ${percent(row.backwards, 0)}` },
        { label: "Span, rad or m", numeric: true, cell: (row) => number(row.span) },
        { label: "Range visited", numeric: true, cell: (row) => percent(row.visited, 0) },
        { label: "Most collinear", numeric: true, cell: (row) => `${row.collinear_term} ${percent(row.collinear, 0)}` },
      ],
      found.joints,
      { caption: `How well friction can be told from ${beside}; ± is the standard deviation that the data leave` },
    ),
    whole
      ? h(
          "p",
          {},
          `Rigid bodies: ${whole.rank} of ${whole.parameters} base parameters are excited enough. `,
          `Weakest: the body that ${whole.weakest_body} moves, with ${percent(whole.weakest)} of what random motion gives.`,
        )
      : h("p", { class: "hint" }, "Rigid bodies are judged only if the upload names a robot with a URDF."),
    found.motion_dimensions == null
      ? null
      : h("p", {}, `The joints move like ${number(found.motion_dimensions, 2)} independent ones of ${found.joints.length}, and all stand still in ${percent(found.standstill, 0)} of the samples.`),
    h("details", {}, h("summary", {}, "The same in words"), h("p", {}, prose(found.text))),
  );
}

function againstRobot(found, joints) {
  if (!found) return null;
  const times = (part) => (row) => (row[part] === null ? "–" : `${number(row[part], 3)} ± ${number(row[`${part}_std`], 2)}`);
  return card(
    `Torque against that of ${found.robot}`,
    table(
      [
        short(joints),
        { label: "Gravity, times", numeric: true, cell: times("gravity") },
        { label: "Inertia, times", numeric: true, cell: times("inertia") },
        { label: "Explained with friction", numeric: true, cell: (row) => percent(row.explained, 0) },
      ],
      found.joints,
      { caption: "1: as the robot's URDF has it. Rotors, which it lacks, make inertia larger, loads both" },
    ),
  );
}

function limits(rows, joints) {
  if (!rows?.length) return null;
  const used = (share, beyond) => (row) => {
    if (row[share] === null) return "–";
    return row[beyond] > 0 ? badge(`${percent(row[share], 0)}, beyond in ${percent(row[beyond], 2)}`, "bad") : percent(row[share], 0);
  };
  return card(
    "Against the robot's limits",
    table(
      [
        short(joints),
        { label: "Range used", numeric: true, cell: used("range_used", "beyond_range") },
        { label: "Speed, of limit", numeric: true, cell: used("speed_used", "beyond_speed") },
        { label: "Torque, of limit", numeric: true, cell: used("torque_used", "beyond_torque") },
      ],
      rows,
      { caption: "Outside what is used here, a model has to extrapolate" },
    ),
  );
}

function ranges(report, joints) {
  const between = (name) => (row) => `${number(report.ranges[name]?.min[row.index])} … ${number(report.ranges[name]?.max[row.index])}`;
  return card(
    "Ranges",
    table(
      [
        short(joints),
        { label: "q, rad or m", numeric: true, cell: between("q") },
        { label: "dq, per s", numeric: true, cell: between("dq") },
        { label: "ddq, per s²", numeric: true, cell: between("ddq") },
        { label: "tau, N·m or N", numeric: true, cell: between("tau") },
      ],
      joints.map((joint, index) => ({ joint, index })),
      { caption: "Smallest and largest value" },
    ),
  );
}

function noise(report, joints) {
  const rows = report.noise ?? joints.map((joint, index) => ({ joint, torque: report.torque_noise_estimate[index], torque_share: null, velocity: null }));
  return card(
    "Noise",
    table(
      [
        short(joints),
        { label: "Torque, N·m", numeric: true, cell: (row) => (row.smoothed ? "smoothed" : number(row.torque, 2)) },
        { label: "of its spread", numeric: true, cell: (row) => percent(row.torque_share) },
        { label: "Velocity, per s", numeric: true, cell: (row) => number(row.velocity, 2) },
        { label: "of its spread", numeric: true, cell: (row) => percent(row.velocity_share) },
      ],
      rows,
      { caption: report.noise ? "Standard deviation of white noise, as recorded" : "Standard deviation of white noise on the torque, as prepared" },
    ),
  );
}

function lag(rows) {
  if (!rows?.length) return null;
  const told = rows.filter((row) => row.seconds !== null);
  const why = new Map();
  for (const row of rows.filter((each) => each.seconds === null)) why.set(row.reason, [...(why.get(row.reason) ?? []), row]);
  return card(
    "Lag of torque behind motion",
    told.length
      ? table(
          [
            { label: "Joint", cell: (row) => row.joint ?? "all together" },
            { label: "Lag, ms", numeric: true, cell: (row) => `${number(1e3 * row.seconds, 2)} ± ${number(1e3 * row.std_s, 2)}` },
            { label: "Costs, of variance", numeric: true, cell: (row) => percent(row.cost, 2) },
          ],
          told,
          { caption: "Negative: the torque comes first; ± one standard deviation" },
        )
      : null,
    [...why].map(([reason, who]) =>
      h("p", {}, `Cannot be told for ${who.map((row) => row.joint ?? "all joints together").join(", ")}: `, reason),
    ),
  );
}

function timing(report) {
  const found = report.timing;
  if (!found) return null;
  return card(
    "Timing",
    facts([
      ["Rate as uploaded", found.rate_hz === null ? "not known" : `${number(found.rate_hz, 4)} Hz`],
      ["Jitter, 50 / 99 % of steps", `${percent(found.jitter_p50)} / ${percent(found.jitter_p99)}`],
      ["Largest jitter", percent(found.jitter_max)],
      ["Gaps", count(report.gaps)],
      ["Repeated stamps left out", count(found.repeated_stamps)],
      ["Rows left out, value missing", count(found.missing_rows)],
    ]),
    found.gaps.length
      ? table(
          [
            { label: "After t, s", numeric: true, cell: (row) => number(row.t, 6) },
            { label: "Lasts", numeric: true, cell: (row) => seconds(row.seconds) },
          ],
          found.gaps,
          { caption: "The longest gaps, at most 20" },
        )
      : null,
  );
}

function saturation(rows, joints) {
  if (!rows?.length) return null;
  return card(
    "Signs of saturation",
    table(
      [
        short(joints),
        { label: "At its extremes", numeric: true, cell: (row) => percent(row.at_largest, 2) },
        { label: "Flat while moving", numeric: true, cell: (row) => (row.flat > 0 ? badge(percent(row.flat, 2), "warn") : percent(row.flat, 2)) },
        { label: "At the robot's limit", numeric: true, cell: (row) => (row.at_limit > 0 ? badge(percent(row.at_limit, 2), "warn") : percent(row.at_limit, 2)) },
      ],
      rows,
      { caption: "Share of samples whose torque may have been cut off" },
    ),
  );
}

function preparation(report) {
  const figures = { source: report.source, recipe: report.recipe, steps: report.steps };
  const steps = report.preparation.length ? sentences(report.preparation) : h("p", {}, "Nothing was changed.");
  return card(
    "How it was read and prepared",
    report.reading.length ? sentences(report.reading) : null,
    h("h3", {}, "Preparation"),
    steps,
    h("details", {}, h("summary", {}, "Everything, in figures"), h("pre", {}, h("code", {}, JSON.stringify(figures, null, 2)))),
  );
}
