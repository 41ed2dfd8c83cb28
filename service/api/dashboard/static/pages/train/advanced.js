// Options of the fit, from the service's OpenAPI description: names, defaults, limits, explanations.

import { get } from "../../api.js";
import { Await, Field, useRead } from "../../components.js";
import { html } from "../../preact.js";

/** Fields of all options. values: the changed ones by name. */
export function Advanced({ values, onchange }) {
  const schemas = useRead(async (signal) => (await get("/openapi.json", {}, signal)).components.schemas.Options.properties, []);
  const set = (name, value) => {
    const { [name]: _last, ...others } = values;
    onchange(value === undefined ? others : { ...others, [name]: value });
  };
  return html`<fieldset>
    <legend>Fit</legend>
    <${Await} reading=${schemas} what="Loading the options">${(found) => html`<div class="grid">
      ${Object.entries(found).map(([name, schema]) => html`<${Option} key=${name} name=${name} schema=${schema} value=${values[name]} onchange=${(value) => set(name, value)} />`)}
    </div>`}<//>
  </fieldset>`;
}

function Option({ name, schema, value, onchange }) {
  const hint = [schema.description, schema.default !== "" && `Default: ${schema.default}.`].filter(Boolean).join(". ").replaceAll("`", "");
  const called = `options.${name}`;
  const known = schema.enum ?? (schema.type === "boolean" ? [true, false] : null);
  const chosen = (event) => known[event.target.selectedIndex];
  const select = (attributes) => html`<select ...${attributes} name=${called} onChange=${(event) => onchange(chosen(event) === schema.default ? undefined : chosen(event))}>
    ${known.map((each) => html`<option key=${each} value=${String(each)} selected=${each === (value ?? schema.default)}>${String(each)}</option>`)}
  </select>`;
  const number = (attributes) => html`<input ...${attributes} type="number" name=${called} min=${schema.minimum} max=${schema.maximum} step=${schema.type === "integer" ? "1" : "any"}
    placeholder=${schema.default} value=${value ?? ""} onInput=${(event) => onchange(event.target.value === "" ? undefined : event.target.valueAsNumber)} />`;
  const text = (attributes) => html`<input ...${attributes} name=${called} value=${value ?? ""} onInput=${(event) => onchange(event.target.value.trim() || undefined)} />`;
  return html`<${Field} label=${name.replaceAll("_", " ")} hint=${hint} input=${known ? select : schema.type === "string" ? text : number} />`;
}
