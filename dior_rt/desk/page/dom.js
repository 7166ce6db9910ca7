// Small helpers for building the page without a framework.

/** An element: properties, `on…` handlers, `aria…`/`data…` attributes, children (nodes, strings, null). */
export function el(tag, props = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (value === undefined || value === null) continue;
    if (name.startsWith('on')) node.addEventListener(name.slice(2), value);
    else if (name === 'class') node.className = value;
    else if (name.includes('-') || name === 'role' || name === 'for' || name === 'list') node.setAttribute(name, value);
    else node[name] = value;
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return node;
}

const PATHS = {
  brush: 'M14 3l3 3-8 8-3.5.5L6 11zM5 14c-2 0-2.5 1.5-2.5 3.5 2 .3 4.5-.2 4.5-2.2',
  eraser: 'M8 16h9M3.5 12.5l8-8 5 5-6.5 6.5H7z',
  lasso: 'M10 4c4 0 7 2 7 4.5S14 13 10 13 3 11 3 8.5 6 4 10 4zM6 12.5c-1 1 0 2 1 2s1.5 1.5 0 3',
  gradient: 'M3 4h14v12H3zM7 4v12M10.5 4v12M13 4v12M15 4v12',
  glow: 'M10 7a3 3 0 100 6 3 3 0 000-6zM10 2v2M10 16v2M2 10h2M16 10h2M4.3 4.3l1.5 1.5M14.2 14.2l1.5 1.5M4.3 15.7l1.5-1.5M14.2 5.8l1.5-1.5',
  picker: 'M11 6l3 3M12.5 4.5c1-1 2-1.5 3-.5s.5 2-.5 3l-2 2-2.5-2.5zM11.5 7.5L5 14l-1.5 2.5L6 15l6.5-6.5',
  hand: 'M10 2v16M2 10h16M10 2L8 4M10 2l2 2M10 18l-2-2M10 18l2-2M2 10l2-2M2 10l2 2M18 10l-2-2M18 10l-2 2',
  undo: 'M7 5L3.5 8.5 7 12M4 8.5h7.5a4 4 0 010 8H8', redo: 'M13 5l3.5 3.5L13 12M16 8.5H8.5a4 4 0 000 8H12',
  plus: 'M10 4v12M4 10h12', copy: 'M7 7h9v9H7zM4 13V4h9', trash: 'M4 6h12M8 6V4h4v2M6 6l.7 10h6.6L14 6', up: 'M5 12l5-5 5 5', down: 'M5 8l5 5 5-5',
  on: 'M2 10c2-3.5 5-5 8-5s6 1.5 8 5c-2 3.5-5 5-8 5s-6-1.5-8-5zM10 7.5a2.5 2.5 0 100 5 2.5 2.5 0 000-5z',
  off: 'M2 10c2-3.5 5-5 8-5s6 1.5 8 5c-2 3.5-5 5-8 5s-6-1.5-8-5zM4 16L16 4',
  help: 'M7.5 7.5c0-3 5-3 5 0 0 2-2.5 2-2.5 4M10 14.5v.5', theme: 'M10 3a7 7 0 100 14zM10 3a7 7 0 010 14',
  swap: 'M4 8h11l-3-3M16 12H5l3 3', fit: 'M3 7V3h4M13 3h4v4M17 13v4h-4M7 17H3v-4', rotate: 'M15.5 8A6 6 0 104.5 12M15.5 3.5V8H11', camera: 'M3 6h3l1.5-2h5L14 6h3v10H3zM10 8a3 3 0 100 6 3 3 0 000-6z',
  full: 'M11.5 8.5L17 3M12.5 3H17v4.5M8.5 11.5L3 17M7.5 17H3v-4.5', columns: 'M3 4h6v12H3zM11 4h6v12h-6z', close: 'M5 5l10 10M15 5L5 15',
};

/** A line icon, hidden from screen readers: its button carries the label. */
export function icon(name) {
  const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  svg.setAttribute('viewBox', '0 0 20 20');
  svg.setAttribute('aria-hidden', 'true');
  svg.classList.add('icon');
  const path = document.createElementNS(svg.namespaceURI, 'path');
  path.setAttribute('d', PATHS[name]);
  svg.append(path);
  return svg;
}

/** A button that shows an icon. */
export function iconButton(name, label, onclick, props = {}) {
  return el('button', { type: 'button', class: 'icon-button', title: label, 'aria-label': label, onclick, ...props }, icon(name));
}

/** One of several buttons of which one is pressed; `value()` reads and `show(value)` sets it. */
export function segmented(label, choices, hints, onpick) {
  const buttons = Object.entries(choices).map(([value, text]) =>
    el('button', { type: 'button', title: hints?.[value] ?? text, 'aria-pressed': 'false', 'data-value': value, onclick: () => onpick(value) }, text));
  const node = el('div', { class: 'segmented', role: 'group', 'aria-label': label }, buttons);
  const show = (value) => buttons.forEach((button) => button.setAttribute('aria-pressed', String(button.dataset.value === value)));
  return { node, show };
}

let counter = 0;

/** A labelled slider with a number beside it. `map` turns slider positions into values and back. */
export function slider({ label, min, max, step, map, format, onvalue, ticks, className = '' }) {
  const id = `s${counter++}`;
  const toValue = map?.value ?? ((x) => x);
  const toPosition = map?.position ?? ((x) => x);
  const text = format ?? ((value) => String(value));
  const input = el('input', { type: 'range', id, min, max, step, class: className });
  const output = el('output', { for: id });
  const marks = ticks?.map((value) => {
    // A mark that is near its neighbour has no room for its number.
    const mark = el('i', { 'aria-hidden': 'true' }, value > 1 && value < max / 4 ? '' : String(value));
    mark.style.left = `${(100 * (toPosition(value) - min)) / (max - min)}%`;
    return mark;
  });
  input.addEventListener('input', () => {
    show(toValue(Number(input.value)));
    onvalue(toValue(Number(input.value)), false);
  });
  input.addEventListener('change', () => onvalue(toValue(Number(input.value)), true));
  function show(value) {
    input.value = toPosition(value);
    output.textContent = text(value);
    input.setAttribute('aria-valuetext', text(value));
    input.style.setProperty('--fill', `${(100 * (input.value - min)) / (max - min)}%`);
  }
  const node = el('div', { class: `row slider ${ticks ? 'ticked' : ''}` }, el('label', { for: id }, label),
    el('div', { class: 'track' }, input, ticks ? el('div', { class: 'ticks' }, marks) : null), output);
  return { node, show, input };
}

/** Offer bytes as a download. */
export function download(blob, name) {
  const link = el('a', { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
