// Select for a robot: a known one or an uploaded URDF. Used for uploads and training.

import { get, pages } from "../../api.js";
import { h, replace } from "../../dom.js";
import { counted } from "../../format.js";
import { prose } from "./prose.js";
import { urdfButton } from "./urdf.js";

/** Meanings of the effort of a recording. */
export const EFFORTS = {
  measured: "measured torque, gravity included",
  commanded: "commanded torque, added to gravity compensation",
  current: "motor current (requires torque constants)",
  unknown: "unknown for this robot: choose its meaning",
};

/** Read the robots, as {profiles, uploaded}. */
export async function robots(signal) {
  const [known, uploaded] = await Promise.all([
    get("/v1/robots/profiles", {}, signal),
    pages("/v1/robots", 200, {}, signal),
  ]);
  return { profiles: known.items, uploaded };
}

/**
 * Create a select of robots and a line that describes the chosen one.
 * withUrdf: list only robots with a URDF; onchange(profile): undefined for an uploaded URDF.
 * Returns {select, note, add, fill(robots), choose(name)}. `fill` keeps the choice; `add` uploads a URDF and chooses it.
 */
export function robotSelect({ none, withUrdf = false, onchange = () => {} }) {
  const select = h("select", { name: "robot" }, h("option", { value: "" }, none));
  const note = h("p", { class: "hint" });
  let profiles = new Map();
  let last = { profiles: [], uploaded: [] };

  const update = () => {
    const profile = profiles.get(select.value);
    replace(note, profile ? prose(describeProfile(profile, withUrdf)) : "");
    onchange(profile);
  };
  select.addEventListener("change", update);

  const fill = (found) => {
    last = found;
    const { profiles: known, uploaded } = found;
    const chosen = select.value;
    const usable = known.filter((each) => !withUrdf || each.urdf_available);
    profiles = new Map(known.map((each) => [each.name, each]));
    replace(
      select,
      h("option", { value: "" }, none),
      group("Known robots", usable.map((each) => [each.name, `${each.name} – ${each.title}`])),
      group("Uploaded URDFs", uploaded.map((each) => [each.id, `${each.name} (${each.id})`])),
    );
    choose(chosen);
  };
  const choose = (name) => {
    select.value = name;
    if (select.selectedIndex < 0) select.value = "";
    update();
  };
  const add = urdfButton((robot) => {
    fill({ ...last, uploaded: [robot, ...last.uploaded.filter((each) => each.id !== robot.id)] });
    choose(robot.id);
  });
  return { select, note, add, fill, choose };
}

function group(label, options) {
  if (!options.length) return "";
  return h("optgroup", { label }, ...options.map(([value, text]) => h("option", { value }, text)));
}

function describeProfile(profile, withUrdf) {
  const joints = `${counted(profile.joints.length, "joint")}: ${profile.joints.map((each) => each.name).join(", ")}.`;
  return withUrdf ? joints : `${joints} Its effort: ${EFFORTS[profile.effort]}. ${profile.effort_note}`;
}
