// Controls of the live plots: time window, large joint, and a cursor for the keyboard.

import { h } from "../../dom.js";
import { field, select } from "../../ui.js";
import { WINDOWS_S } from "./rows.js";

const LARGEST = "largest innovation";

/**
 * Create the controls. choice: {window, joint, cursor}, updated here and stored in the query of the address.
 * changed(): called to redraw; point(x): called when the cursor moves, null if it is removed. Returns {element, pick(joint), point(x)}.
 */
export function toolbar(name, joints, choice, query, { changed, point }) {
  if (WINDOWS_S.includes(Number(query.get("window")))) choice.window = Number(query.get("window"));
  if (joints.includes(query.get("joint"))) choice.joint = joints.indexOf(query.get("joint"));
  const remember = () => {
    const kept = { ...(choice.window === 30 ? {} : { window: choice.window }), ...(choice.joint === null ? {} : { joint: joints[choice.joint] }) };
    const search = new URLSearchParams(kept).toString();
    history.replaceState(null, "", `#/live/${encodeURIComponent(name)}${search && `?${search}`}`);
    slider.min = String(-choice.window);
    changed();
  };
  const pick = (joint) => {
    choice.joint = joint;
    large.value = joint === null ? "" : joints[joint];
    remember();
  };
  const windows = select(WINDOWS_S.map((each) => [String(each), each < 60 ? `${each} s` : `${each / 60} min`]), String(choice.window), (value) => {
    choice.window = Number(value);
    remember();
  });
  const large = select([["", LARGEST], ...joints], choice.joint === null ? "" : joints[choice.joint], (value) => pick(value ? joints.indexOf(value) : null));
  const slider = h("input", { type: "range", min: -choice.window, max: 0, step: "any", value: 0, "aria-label": "Cursor, seconds before the newest row", oninput: () => point(slider.valueAsNumber || null) });
  const at = h("output", { class: "muted" });
  const show = (x) => {
    at.textContent = x === null ? "now" : `${x.toFixed(1)} s`;
    slider.setAttribute("aria-valuetext", at.textContent);
    if (document.activeElement !== slider) slider.value = String(x ?? 0);
  };
  show(null);
  const element = h(
    "div",
    { class: "grid thirds" },
    field("Time window", windows),
    field("Large plot", large),
    h("div", { class: "field" }, h("span", { class: "row", "aria-hidden": "true" }, h("b", {}, "Cursor"), at), slider),
  );
  return { element, pick, point: show };
}
