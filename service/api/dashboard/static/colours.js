// Colours of the theme and of the joints. HTML and SVG follow the theme through CSS variables; plots need #rrggbb values.

/** Number of joint colours; further joints repeat them. */
export const JOINT_COLOURS = 8;
const DARK = matchMedia("(prefers-color-scheme: dark)");
const cache = new Map();

/** Return the CSS variable of a joint's colour, `var(--joint-3)`. index: 0 for the first joint. */
export function jointVar(index) {
  return `var(--joint-${(index % JOINT_COLOURS) + 1})`;
}

/** Return a joint's colour as #rrggbb, for plots; draw again on `themechange`. index: 0 for the first joint. */
export function jointColour(index) {
  return css(`joint-${(index % JOINT_COLOURS) + 1}`);
}

/** Return the current #rrggbb value of a CSS variable, named with or without --; "" if it does not exist. */
export function css(name) {
  const variable = name.startsWith("--") ? name : `--${name}`;
  const place = `${document.documentElement.dataset.theme} ${DARK.matches} ${variable}`;
  if (!cache.has(place)) cache.set(place, computedColour(variable));
  return cache.get(place);
}

/** Return a colour #rrggbb with an opacity. */
export function withOpacity(colour, opacity) {
  const parts = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  return `rgba(${parts},${opacity})`;
}

// the variable is light-dark(…, …); only the computed colour of an element belongs to the current theme
function computedColour(variable) {
  if (!getComputedStyle(document.documentElement).getPropertyValue(variable)) return "";
  const probe = document.createElement("span");
  probe.hidden = true;
  probe.style.color = `var(${variable})`;
  document.documentElement.append(probe);
  const parts = getComputedStyle(probe).color.match(/\d+/g).slice(0, 3);
  probe.remove();
  return `#${parts.map((part) => Number(part).toString(16).padStart(2, "0")).join("")}`;
}
