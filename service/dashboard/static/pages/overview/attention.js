// What somebody has to decide or should know: learning that is held, alarms of the last day, a learner that failed.

import { get, path } from "../../api.js";
import { h, refresh } from "../../dom.js";
import { when } from "../../format.js";
import { badge, card, link } from "../../ui.js";
import { changed } from "./follow.js";

const MODELS = 10;
const NEW_MS = 86_400_000;

/** Ask the newest models what there is to know: [{model, state, text, at, hash}], what is to be decided first. */
export async function warnings(models, signal) {
  const each = await Promise.all(models.slice(0, MODELS).map((model) => ofModel(model.name, signal)));
  return each.flat().sort((a, b) => Number(b.state === "held") - Number(a.state === "held"));
}

async function ofModel(name, signal) {
  let learning;
  let alarms;
  try {
    [learning, alarms] = await Promise.all([
      get(path`/v1/models/${name}/learning`, {}, signal),
      get(path`/v1/models/${name}/alarms`, { limit: 1 }, signal),
    ]);
  } catch (error) {
    if (error.status === 404) return []; // deleted a moment ago
    throw error;
  }
  const hash = `#/live/${encodeURIComponent(name)}`;
  const found = [];
  const [newest] = alarms.items;
  const { held, failure } = learning.status;
  if (held) {
    const text = "Learning is held: the robot seems to have changed. Decide whether to adapt or to go on.";
    found.push({ model: name, state: "held", text, at: held.at ?? null, hash });
  }
  if (failure) found.push({ model: name, state: "error", text: `Learning does not work: ${failure}`, at: null, hash });
  if (newest && !held && Date.now() - new Date(newest.at).getTime() < NEW_MS) {
    found.push({ model: name, state: newest.kind === "promotion" ? "promotion" : "warning", text: newest.message, at: newest.at, hash });
  }
  return found;
}

/** Show them; nothing where there is nothing to say. */
export function attention(place, found) {
  if (!changed(place, found)) return;
  const item = ({ model, state, text, at, hash }) =>
    h("li", { "data-key": `${model} ${state}` }, h("div", { class: "row" }, badge(state), link(model, hash), h("span", {}, text), at ? h("span", { class: "muted" }, when(at)) : null));
  refresh(place, found.length ? card("Needs attention", h("ul", { class: "rows" }, found.map(item))) : null);
}
