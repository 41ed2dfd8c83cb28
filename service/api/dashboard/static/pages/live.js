// Live page: list of streaming robots, or live plots and online learning of one model.

import { pages } from "../api.js";
import { Await, page, useRead } from "../components.js";
import { html, useEffect } from "../preact.js";
import { Follow } from "./live/follow.js";
import { Robots } from "./live/robots.js";

const MAX_MODELS = 500;

/** The pages `#/live`, a list of robots, and `#/live/{name}`; `?window=120&joint=joint4` sets the view. */
function Live({ name, query, signal, title }) {
  useEffect(() => title(name ? `${name} live` : "Live"), []);
  const models = useRead((until) => (name ? pages("/v1/models", MAX_MODELS, {}, until) : []), []);
  if (!name) return html`<${Robots} />`;
  return html`<${Await} reading=${models}>${(found) => html`<${Follow} name=${name} models=${found.map((model) => model.name)} query=${query} signal=${signal} />`}<//>`;
}

export const render = page(Live);
