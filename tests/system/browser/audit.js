// Accessibility audit of the page: returns a sentence for each problem.
() => {
  const problems = [];
  const shown = (node) => node.checkVisibility({visibilityProperty: true}) && !node.closest('[aria-hidden=true]');
  const where = (node) => node.outerHTML.slice(0, 120).replace(/\s+/g, ' ');
  const all = (selector) => [...document.querySelectorAll(selector)].filter(shown);
  const named = (node) =>
    (node.getAttribute('aria-label') || '').trim() ||
    (node.getAttribute('aria-labelledby') || '').split(/\s+/).some((id) => id && document.getElementById(id)?.textContent.trim()) ||
    [...(node.labels || [])].some((label) => label.textContent.trim()) ||
    (node.textContent || '').trim() || (node.getAttribute('title') || '').trim();

  if (!document.documentElement.lang) problems.push('the document names no language');
  if (!document.title.trim()) problems.push('the document has no title');
  if (all('main').length !== 1) problems.push(`${all('main').length} main landmarks, expected 1`);
  if (all('nav').length < 1) problems.push('no nav landmark');

  const labelled = (node) => node.tagName === 'SELECT' || node.tagName === 'TEXTAREA' || node.tagName === 'INPUT'
    ? (node.getAttribute('aria-label') || '').trim() || [...(node.labels || [])].some((label) => label.textContent.trim())
      || (node.getAttribute('aria-labelledby') || '').trim()
    : named(node);
  for (const node of all('input:not([type=hidden]), select, textarea'))
    if (!labelled(node)) problems.push(`input without a label: ${where(node)}`);
  for (const node of all('button, a[href], [role=button], [role=tab], summary'))
    if (!named(node)) problems.push(`control without a name: ${where(node)}`);
  for (const node of all('img, [role=img], .js-plotly-plot'))
    if (!(node.hasAttribute('alt') || named(node) && node.getAttribute('aria-label')
          || node.closest('[role=img][aria-label], figure[aria-label], [aria-label]')))
      problems.push(`picture or plot without a text: ${where(node)}`);
  for (const node of all('[onclick], [tabindex]'))
    if (node.tabIndex > 0) problems.push(`tab order changed by tabindex ${node.tabIndex}: ${where(node)}`);
  for (const node of all('progress, [role=progressbar]'))
    if (!named(node)) problems.push(`progress without a name: ${where(node)}`);
  for (const node of all('table')) {
    if (!node.querySelector('th')) problems.push(`table without headers: ${where(node)}`);
    for (const head of node.querySelectorAll('tbody th'))
      if (!head.getAttribute('scope')) problems.push(`row header without scope: ${where(head)}`);
  }

  let level = 0;
  const headings = all('h1, h2, h3, h4, h5, h6, [role=heading]').filter((node) => !node.closest('dialog'));
  for (const node of headings) {
    const next = Number(node.getAttribute('aria-level') || node.tagName.slice(1));
    if (next > level + 1) problems.push(`heading of level ${next} after level ${level}: ${node.textContent.trim().slice(0, 60)}`);
    level = next;
  }
  if (headings.filter((node) => node.tagName === 'H1').length !== 1) problems.push('not exactly one h1');

  const ids = new Map();
  for (const node of document.querySelectorAll('[id]')) ids.set(node.id, (ids.get(node.id) || 0) + 1);
  for (const [id, count] of ids)
    if (count > 1 && !document.getElementById(id).closest('.js-plotly-plot')) problems.push(`id ${id} is there ${count} times`);

  // contrast of text with its background, as defined by WCAG 2
  const channel = (value) => (value /= 255) <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
  const luminance = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
  const canvas = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
  const rgba = (colour) => {
    canvas.clearRect(0, 0, 1, 1); canvas.fillStyle = '#000'; canvas.fillStyle = colour; canvas.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = canvas.getImageData(0, 0, 1, 1).data;
    return [r, g, b, a / 255];
  };
  const over = (top, below) => top.slice(0, 3).map((value, i) => value * top[3] + below[i] * (1 - top[3]));
  const background = (node) => {
    const layers = [];
    for (let at = node; at; at = at.parentElement) {
      const style = getComputedStyle(at);
      if (style.backgroundImage !== 'none') return null;
      const colour = rgba(style.backgroundColor);
      if (colour[3] > 0) layers.push(colour);
      if (colour[3] > 0.999) break;
    }
    return layers.reverse().reduce((below, top) => over(top, below), rgba(getComputedStyle(document.documentElement).backgroundColor)[3]
      ? over(rgba(getComputedStyle(document.documentElement).backgroundColor), [255, 255, 255]) : [255, 255, 255]);
  };
  const seen = new Set();
  for (const node of all('body *')) {
    if (node.closest('svg, .js-plotly-plot, option') || node.matches(':disabled, :disabled *, [aria-disabled=true]')) continue;
    if (![...node.childNodes].some((child) => child.nodeType === 3 && child.textContent.trim())) continue;
    const style = getComputedStyle(node), box = node.getBoundingClientRect();
    if (box.width < 2 || box.height < 2 || style.clipPath !== 'none') continue;
    const below = background(node);
    if (!below) continue;
    let opacity = 1;
    for (let at = node; at; at = at.parentElement) opacity *= Number(getComputedStyle(at).opacity);
    if (opacity === 0) continue;
    const ink = rgba(style.color);
    ink[3] *= opacity;
    const [light, dark] = [luminance(over(ink, below)), luminance(below)].sort((a, b) => b - a);
    const ratio = (light + 0.05) / (dark + 0.05);
    const size = parseFloat(style.fontSize), large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    const key = `${style.color} on ${below.map(Math.round)}`;
    if (ratio < (large ? 3 : 4.5) && !seen.has(key)) {
      seen.add(key);
      problems.push(`contrast ${ratio.toFixed(2)} of ${key}: ${where(node)}`);
    }
  }
  return problems;
}
