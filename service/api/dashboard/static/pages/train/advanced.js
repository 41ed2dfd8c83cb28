// Options of the fit, from the service's OpenAPI description: names, defaults, limits, explanations.

import { get } from "../../api.js";
import { h, replace } from "../../dom.js";
import { errorBox, field, loading } from "../../ui.js";

/** Create this part of the form; it is loaded when it is opened. Returns {element, jointTypes(), values()}; values(): changed options. */
export function advancedOptions(signal) {
  const place = h("div", {});
  const inputs = new Map();
  let loaded = false;
  const load = async () => {
    replace(place, loading());
    try {
      const { components } = await get("/openapi.json", {}, signal);
      const options = Object.entries(components.schemas.Options.properties);
      replace(place, h("div", { class: "grid" }, options.map(([name, schema]) => optionField(inputs, name, schema))));
    } catch (error) {
      if (error.name !== "AbortError") replace(place, errorBox(error, load));
    }
  };
  const opened = (event) => {
    if (!event.target.open || loaded) return;
    loaded = true;
    load();
  };
  const types = h("input", { type: "text", name: "joint_types", placeholder: "joint types of the robot, or revolute", autocomplete: "off" });
  return {
    element: h(
      "details",
      { ontoggle: opened },
      h("summary", {}, "Advanced options"),
      field("Joint types", types, "revolute or prismatic for each joint, separated by commas."),
      place,
    ),
    jointTypes: () => types.value.split(",").map((each) => each.trim()).filter(Boolean),
    values: () => Object.fromEntries([...inputs].flatMap(([name, read]) => (read() === undefined ? [] : [[name, read()]]))),
  };
}

function optionField(inputs, name, schema) {
  const label = name.replaceAll("_", " ");
  const called = { name: `options.${name}` };
  const hint = [schema.description, `Default: ${schema.default}.`].filter(Boolean).join(". ").replaceAll("`", "");
  if (schema.type === "boolean" || schema.enum) {
    const values = schema.enum ?? [true, false];
    const input = h("select", called, values.map((value) => h("option", { value: String(value), selected: value === schema.default }, String(value))));
    const chosen = () => values[input.selectedIndex];
    inputs.set(name, () => (chosen() === schema.default ? undefined : chosen()));
    return field(label, input, hint);
  }
  const input = h("input", {
    ...called,
    type: "number",
    min: schema.minimum,
    max: schema.maximum,
    step: schema.type === "integer" ? "1" : "any",
    placeholder: String(schema.default),
  });
  inputs.set(name, () => (input.value === "" ? undefined : input.valueAsNumber));
  return field(label, input, hint);
}
