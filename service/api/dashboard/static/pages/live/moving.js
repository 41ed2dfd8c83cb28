// The followed model's arm, moving as the newest row of the stream says. Only for versions that hold their geometry.

import { get, path } from "../../api.js";
import { h, replace } from "../../dom.js";
import { card, explained } from "../../ui.js";
import { CANNOT, drawable, drawing } from "../arm/drawing.js";

const HEIGHT = 256;

/** The arm in a place; draw(status, joint) moves it to pose(), the newest positions, where it can be seen; joint: thick. */
export function moving(place, name, pose, signal) {
  let made = null, version = null, seen = false, at = null, thick = null, left = null;
  const watch = new IntersectionObserver((entries) => (seen = entries.at(-1).isIntersecting), { rootMargin: "200px 0px" });
  signal.addEventListener("abort", () => {
    watch.disconnect();
    left?.abort();
  });
  const begin = async (number, q) => {
    version = number;
    left?.abort();
    left = new AbortController();
    made = null;
    const found = await shown(name, number, signal);
    if (!found?.parameters.geometry || !drawable()) return replace(place);
    const figure = h("div", { style: `height: ${HEIGHT}px` });
    replace(place, card("The arm", figure, explained(`At the positions of the newest row; the joint that is shown large is thick. ${CANNOT}`)));
    watch.disconnect();
    watch.observe(figure);
    made = await drawing(figure, found, q, { height: HEIGHT, legend: false, signal: left.signal });
  };
  return {
    async draw(status, joint) {
      const q = pose();
      if (q === null || signal.aborted) return;
      if (status.version !== version) await begin(status.version, q);
      else if (made && seen && (q !== at || joint !== thick)) await made.draw(q, joint);
      [at, thick] = [q, joint];
    },
  };
}

/** A version, null where it cannot be had: it was deleted meanwhile, or the page was left. */
async function shown(name, number, signal) {
  try {
    return await get(path`/v1/models/${name}/versions/${number}`, {}, signal);
  } catch (error) {
    if (error.name === "ApiError" || error.name === "AbortError") return null;
    throw error;
  }
}
