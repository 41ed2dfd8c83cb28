// A plot by Plotly as a component: it is drawn once and updated in place, so that it keeps its zoom and its cursor.

import { ErrorBox } from "./components.js";
import { plot } from "./plots.js";
import { html, useEffect, useRef, useState } from "./preact.js";

/**
 * A plot. draw(): returns [traces, layout] of `plots.js`, called again whenever `inputs` change while the plot is shown;
 * ondrawn(element): called once it is there.
 */
export function Plot({ draw, inputs, label, hidden = false, ondrawn = () => {} }) {
  const place = useRef(null), made = useRef(null), [error, setError] = useState(null);
  const fail = (failure, signal) => {
    if (signal.aborted) return;
    console.error(failure);
    setError(failure);
  };
  const stop = useRef(null), named = useRef(null);
  named.current = label;
  useEffect(() => {
    stop.current = new AbortController();
    return () => stop.current.abort();
  }, []);
  useEffect(() => {
    if (hidden) return;
    const { signal } = stop.current;
    const [traces, layout] = draw();
    if (made.current) {
      made.current.then((there) => !signal.aborted && there.react(traces, layout)).catch((failure) => fail(failure, signal));
      return;
    }
    made.current = plot(place.current, traces, layout, { label, signal });
    made.current.then(() => {
      if (signal.aborted) return;
      place.current.setAttribute("aria-label", named.current); // it may have changed while Plotly was loaded
      ondrawn(place.current);
    }).catch((failure) => fail(failure, signal));
  }, [...inputs, hidden]);
  return html`${error && html`<${ErrorBox} error=${error} />`}<div ref=${place} class="plot" role="img" aria-label=${label} hidden=${hidden}></div>`;
}
