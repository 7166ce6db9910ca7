// Dialogs: export, side by side, keyboard shortcuts.

import { el, iconButton } from './dom.js';
import { t } from './strings.js';

/** Show a modal dialog that is gone once it is closed. */
function show(title, closeLabel, ...children) {
  const dialog = el('dialog', { 'aria-label': title }, el('header', {}, el('h2', {}, title), iconButton('close', closeLabel, () => dialog.close())), children);
  dialog.addEventListener('close', () => dialog.remove());
  dialog.addEventListener('click', (event) => event.target === dialog && dialog.close());
  document.body.append(dialog);
  dialog.showModal();
  return dialog;
}

/** Choose what to export. save(kind), layers(kind); command: the line that repeats the result. */
export function exportDialog({ bits, transparent, hasLights, command, save, layers }) {
  const said = el('span', { role: 'status', class: 'quiet' });
  const line = el('code', {}, command);
  const copy = async () => {
    await navigator.clipboard.writeText(command);
    said.textContent = t.exports.copied;
  };
  const buttons = (formats, act, disabled) =>
    el('div', { class: 'choices' }, Object.entries(formats).map(([kind, name]) =>
      el('button', { type: 'button', disabled: disabled(kind), 'data-kind': kind, onclick: () => {
        dialog.close();
        act(kind);
      } }, name)));
  const dialog = show(t.exports.title, t.exports.close,
    el('h3', {}, t.exports.photo), buttons(t.exports.formats, save, (kind) => kind === 'jpeg' && transparent), el('p', { class: 'quiet' }, t.exports.depth(bits)),
    el('h3', {}, t.exports.layers), buttons(t.exports.layerFormats, layers, () => !hasLights),
    el('h3', {}, t.exports.command), el('p', { class: 'quiet' }, t.exports.commandHint), el('div', { class: 'command' }, line, el('button', { type: 'button', onclick: copy }, t.exports.copy)), said);
  dialog.classList.add('export');
}

export function helpDialog() {
  show(t.help.title, t.help.close, el('dl', { class: 'keys' }, t.help.keys.flatMap(([keys, meaning]) => [el('dt', {}, keys.split(' ').filter(Boolean).map((key) => el('kbd', {}, key))), el('dd', {}, meaning)])));
}

/** Pictures beside one another. snapshots: [{name, bitmap}] */
export function compareDialog(snapshots) {
  const figures = snapshots.map(({ name, bitmap }) => {
    const canvas = el('canvas', { width: bitmap.width, height: bitmap.height, role: 'img', 'aria-label': name });
    canvas.getContext('2d').drawImage(bitmap, 0, 0);
    return el('figure', {}, canvas, el('figcaption', {}, name));
  });
  show(t.snapshots.compare, t.snapshots.close, el('div', { class: 'figures' }, figures)).classList.add('wide');
}
