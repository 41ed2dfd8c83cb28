// Colours of the theme and of the joints. What HTML and SVG show follows the theme by itself; what draws on a canvas reads values.

/** How many joints have a colour of their own; more begin again. */
export const JOINT_COLOURS = 8;
const DARK = matchMedia("(prefers-color-scheme: dark)");
const read = new Map();

/** The colour of a joint as CSS, `var(--joint-3)`, for styles and SVG: it follows the theme. index: 0 for the first. */
export function jointVar(index) {
  return `var(--joint-${(index % JOINT_COLOURS) + 1})`;
}

/** The colour of a joint now, as #rrggbb, for plots: draw again on `themechange`. index: 0 for the first. */
export function jointColour(index) {
  return css(`joint-${(index % JOINT_COLOURS) + 1}`);
}

/** A colour of the theme now, as #rrggbb, by the name of its CSS variable, with or without --; "" where there is none. */
export function css(name) {
  const variable = name.startsWith("--") ? name : `--${name}`;
  const place = `${document.documentElement.dataset.theme} ${DARK.matches} ${variable}`;
  if (!read.has(place)) read.set(place, shown(variable));
  return read.get(place);
}

/** A colour #rrggbb made translucent. */
export function faint(colour, opacity) {
  const parts = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  return `rgba(${parts},${opacity})`;
}

// the variable's text names both themes, light-dark(…, …); the colour of an element is of the one that is shown
function shown(variable) {
  if (!getComputedStyle(document.documentElement).getPropertyValue(variable)) return "";
  const probe = document.createElement("span");
  probe.hidden = true;
  probe.style.color = `var(${variable})`;
  document.documentElement.append(probe);
  const parts = getComputedStyle(probe).color.match(/\d+/g).slice(0, 3);
  probe.remove();
  return `#${parts.map((part) => Number(part).toString(16).padStart(2, "0")).join("")}`;
}
