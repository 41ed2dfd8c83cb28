// Form for one prediction: torque of a state, with its interval.

import { post } from "../../api.js";
import { h, replace } from "../../dom.js";
import { number, shortNames } from "../../format.js";
import { badge, card, errorBox, table } from "../../ui.js";
import { Z95 } from "./curves.js";

const QUANTITIES = [["q", "q, rad"], ["dq", "dq, rad/s"], ["ddq", "ddq, rad/s²"]];

/** Draw the tab. */
export async function predictForm(view, { where, version }, { signal }) {
  const { joint_names: names, training_range: range } = version;
  const short = shortNames(names);
  const middle = (joint) => Number((0.5 * (range.q.min[joint] + range.q.max[joint])).toFixed(3));
  const inputs = Object.fromEntries(QUANTITIES.map(([quantity]) => [
    quantity,
    names.map((name, joint) => h("input", { type: "number", step: "any", required: true, value: String(quantity === "q" ? middle(joint) : 0), "aria-label": `${quantity} of ${name}`, style: "min-width: 4.6rem" })),
  ]));
  const answer = h("div", { "aria-live": "polite" });
  const submit = async (event) => {
    event.preventDefault();
    const motion = Object.fromEntries(QUANTITIES.map(([quantity]) => [quantity, inputs[quantity].map((each) => Number(each.value))]));
    try {
      const found = await post(`${where}/predict`, { ...motion, version: version.version }, signal);
      replace(answer, shown(found, motion, version));
    } catch (error) {
      if (error.name !== "AbortError") replace(answer, errorBox(error));
    }
  };
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    ...QUANTITIES.map(([quantity, label]) => ({ label, cell: (joint) => inputs[quantity][joint] })),
  ];
  replace(
    view,
    card(
      "Predict a torque",
      h("form", { onsubmit: submit }, table(columns, names.map((_name, joint) => joint), { caption: "State in SI units (prismatic joints: m). Initial values: at rest, in the middle of the training range." }), h("button", { type: "submit", class: "primary" }, "Predict")),
      answer,
    ),
  );
}

/** Format a number with the decimals of the two leading digits of its standard deviation. */
function fixed(value, std) {
  const decimals = std > 0 ? Math.min(8, Math.max(0, 1 - Math.floor(Math.log10(std)))) : 4;
  return value.toFixed(decimals);
}

function shown(found, motion, { training_range: range }) {
  const short = shortNames(found.joint_names);
  const total = found.tau_std.map((each, joint) => found.scale[joint] * Math.hypot(each, found.noise_std[joint]));
  const outside = (joint) => QUANTITIES.map(([quantity]) => quantity).filter((quantity) => motion[quantity][joint] < range[quantity].min[joint] || motion[quantity][joint] > range[quantity].max[joint]);
  const beyond = found.joint_names.some((_name, joint) => outside(joint).length);
  const numeric = (label, cell) => ({ label, numeric: true, cell });
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    numeric("tau, N·m", (joint) => fixed(found.tau[joint], found.tau_std[joint])),
    numeric("tau_std", (joint) => number(found.tau_std[joint], 2)),
    numeric("noise_std", (joint) => number(found.noise_std[joint], 2)),
    numeric("95 % interval of measurements", (joint) => `${fixed(found.tau[joint], total[joint])} ± ${fixed(Z95 * total[joint], total[joint])}`),
    { label: "Training range", cell: (joint) => (outside(joint).length ? badge(`${outside(joint).join(", ")} outside`, "warn") : badge("within", "good")) },
  ];
  const revision = found.revision ? `, revision ${found.revision}` : "";
  return [
    beyond ? h("div", { class: "banner", role: "note" }, "This state is partly outside the training range. The version extrapolates: its interval grows, but not always enough. Do not send this torque to a robot without a check.") : null,
    table(columns, found.joint_names.map((_name, joint) => joint), { caption: `Version ${found.version}${revision} of ${found.model}, ${found.torque_convention.replace("_", " ")}` }),
    h("p", { class: "hint" }, "“Within” refers to each value alone, not to their combination."),
  ];
}
