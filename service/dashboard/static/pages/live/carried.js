// What the arm of each stream carries, as far as its rows tell.

import { h } from "../../dom.js";
import { count, when } from "../../format.js";
import { badge, card, table } from "../../ui.js";

const STATES = { none: ["nothing new", "plain"], payload: ["payload", "good"], contact: ["contact", "warn"], friction: ["friction has changed", "warn"] };

/** Mass, state and since when, stream by stream; nothing where the model knows no arm, or no stream has told anything. */
export function carriedCard({ payloads }) {
  if (!payloads?.length) return null;
  const touched = payloads.filter((each) => each.state === "contact").map((each) => each.stream_id);
  return card(
    "Payload",
    touched.length ? h("p", {}, badge(`a contact is seen on ${touched.join(", ")}: torques that no payload explains`, "warn")) : null,
    table(
      [
        { label: "Stream", cell: (each) => each.stream_id },
        { label: "Carries", cell: (each) => h("strong", {}, kilograms(each.mass)) },
        { label: "State", cell: (each) => [badge(...STATES[each.state]), each.declared ? " declared" : null] },
        { label: "Since", cell: (each) => (each.since === null ? "–" : when(each.since)) },
        { label: "Rows", numeric: true, cell: (each) => count(each.rows) },
      ],
      payloads,
      { caption: "What the arm carries beyond what it was trained with, ± one standard deviation", key: (each) => each.stream_id },
    ),
    h("p", { class: "hint" }, "Answers contain it. Where the arm was learnt from torque alone, kilograms are as good as its lengths. No safety function."),
  );
}

/** 1.48 ± 0.03 kg. */
function kilograms(mass) {
  return mass === null ? "nothing" : `${mass.mean.toFixed(2)} ± ${mass.std.toFixed(2)}\u00a0kg`;
}
