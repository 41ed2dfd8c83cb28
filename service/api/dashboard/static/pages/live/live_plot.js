// A plot that is drawn again with each frame while it is visible.

import { ErrorBox } from "../../components.js";
import { plot, plotly } from "../../plots.js";
import { html, useEffect, useRef, useState } from "../../preact.js";

const MARGIN_PX = 300;

/** A plot of `make()`, {traces, layout}, drawn again whenever `inputs` change; linked: its LinkedPlots. */
export function LivePlot({ make, inputs, height, label, linked }) {
  const place = useRef(null), own = useRef({ made: null, isBusy: false }).current;
  const [error, setError] = useState(null);
  const seen = useSeen(place);
  useEffect(() => {
    own.stop = new AbortController();
    const size = new ResizeObserver(async () => {
      if (own.made && place.current?.offsetWidth) (await plotly()).Plots.resize(place.current).catch(() => null);
    });
    size.observe(place.current);
    return () => {
      size.disconnect();
      own.stop.abort();
    };
  }, []);
  useEffect(() => {
    if (own.isBusy || (own.made && !seen.current)) return;
    own.isBusy = true;
    draw(place.current, own, make(), label, linked).catch(setError).finally(() => (own.isBusy = false));
  }, inputs);
  return html`${error && html`<${ErrorBox} error=${error} />`}<div style=${{ height: `${height}px` }} ref=${place}></div>`;
}

/** Return a reference to whether a place is visible or nearly so. */
export function useSeen(place) {
  const seen = useRef(false);
  useEffect(() => {
    const watch = new IntersectionObserver((entries) => (seen.current = entries.at(-1).isIntersecting), { rootMargin: `${MARGIN_PX}px 0px` });
    watch.observe(place.current);
    return () => watch.disconnect();
  }, []);
  return seen;
}

async function draw(element, own, { traces, layout }, label, linked) {
  element.setAttribute("aria-label", label);
  if (own.made) return own.made.react(traces, layout);
  const { signal } = own.stop;
  own.made = await plot(element, traces, layout, { label, signal });
  if (!signal.aborted) linked.add(element);
}
