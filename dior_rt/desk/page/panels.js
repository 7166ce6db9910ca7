// The panel at the side: brush, colour, lights, result, snapshots.

import { fromHex, hueToRgb, kelvinToRgb, mixColor, toCss, toHex } from './color.js';
import { el, icon, iconButton, segmented, slider } from './dom.js';
import { newId, withLight } from './model.js';
import { presetLight, presetNames } from './presets.js';
import { t } from './strings.js';

const percent = (x) => `${Math.round(100 * x)}%`;
const STRENGTHS = [1, 2, 4, 8, 16];
const TINTS = { white: [1, 1, 1], candle: kelvinToRgb(1900), tungsten: kelvinToRgb(3000), shade: kelvinToRgb(9000), moon: [0.45, 0.6, 1] };

const section = (title, ...children) => {
  const id = `p-${title.replace(/\W/g, '')}`;
  return el('section', { class: 'panel', 'aria-labelledby': id }, el('h2', { id }, title), children);
};

export function brushPanel(ui) {
  const set = (key) => (value) => ui.set({ [key]: value });
  const size = slider({
    label: t.brush.size, min: 0, max: 100, step: 0.5, format: percent, onvalue: set('size'),
    map: { value: (x) => 0.004 * 125 ** (x / 100), position: (v) => (100 * Math.log(v / 0.004)) / Math.log(125) },
  });
  const softness = slider({ label: t.brush.softness, min: 0, max: 1, step: 0.01, format: percent, onvalue: set('softness') });
  const flow = slider({ label: t.brush.flow, min: 0.01, max: 1, step: 0.01, format: percent, onvalue: set('flow') });
  const check = (key) => el('input', { type: 'checkbox', onchange: (event) => ui.set({ [key]: event.target.checked }) });
  const [thins, fades] = [check('thins'), check('fades')];
  ui.addEventListener('change', update);
  function update() {
    const { state } = ui;
    size.show(state.size);
    softness.show(state.softness);
    flow.show(state.flow);
    thins.checked = state.thins;
    fades.checked = state.fades;
  }
  update();
  const pressure = el('div', { class: 'row checks', role: 'group', 'aria-label': t.brush.pressure },
    el('span', { class: 'name' }, t.brush.pressure), el('label', {}, thins, t.brush.thins), el('label', {}, fades, t.brush.fades));
  return section(t.brush.title, size.node, softness.node, flow.node, pressure);
}

export function colorPanel(ui, swap) {
  const set = (key) => (value) => ui.set({ color: { ...ui.state.color, [key]: value } });
  const kelvin = slider({ label: t.color.kelvin, min: 1800, max: 12000, step: 50, format: (v) => `${v} K`, onvalue: set('kelvin'), className: 'kelvin' });
  const hue = slider({ label: t.color.hue, min: 0, max: 360, step: 1, format: (v) => `${v}°`, onvalue: set('hue'), className: 'hue' });
  const saturation = slider({ label: t.color.saturation, min: 0, max: 1, step: 0.01, format: percent, onvalue: set('saturation'), className: 'saturation' });
  const strength = slider({ label: t.color.strength, min: 0, max: 16, step: 0.05, format: (v) => String(Math.round(v * 100) / 100), onvalue: set('strength'), ticks: STRENGTHS });
  const current = el('div', { class: 'swatch current', role: 'img', 'aria-label': t.color.current });
  const other = el('button', { type: 'button', class: 'swatch other', 'aria-label': t.color.swap, title: `${t.color.swap} (X)`, onclick: swap });
  kelvin.input.style.setProperty('--ramp', `linear-gradient(90deg, ${[1800, 2500, 3500, 5000, 6500, 8000, 12000].map((k) => `${toCss(kelvinToRgb(k))} ${(100 * (k - 1800)) / 10200}%`).join(', ')})`);
  hue.input.style.setProperty('--ramp', `linear-gradient(90deg, ${[0, 60, 120, 180, 240, 300, 360].map((h) => toCss(hueToRgb(h))).join(', ')})`);
  ui.addEventListener('change', update);
  function update() {
    const { color } = ui.state;
    kelvin.show(color.kelvin);
    hue.show(color.hue);
    saturation.show(color.saturation);
    strength.show(color.strength);
    saturation.input.style.setProperty('--ramp', `linear-gradient(90deg, ${toCss(mixColor({ ...color, saturation: 0 }))}, ${toCss(mixColor({ ...color, saturation: 1 }))})`);
    current.style.background = toCss(mixColor(color));
    other.style.background = toCss(mixColor(ui.state.other));
  }
  update();
  return section(t.color.title, el('div', { class: 'swatches' }, current, other, iconButton('swap', t.color.swap, swap)), kelvin.node, hue.node, saturation.node, strength.node);
}

/** The list of lights and what can be changed of the selected one. */
export function lightsPanel(history, ui) {
  const list = el('ul', { class: 'lights', 'aria-label': t.lights.list });
  const empty = el('p', { class: 'quiet' }, t.lights.none);
  const menu = el('select', { class: 'add', 'aria-label': t.lights.add, onchange: () => {
    add(menu.value);
    menu.value = '';
  } }, el('option', { value: '' }, `+ ${t.lights.add}`), presetNames.map((name) => el('option', { value: name }, t.presets[name])));
  const editor = lightEditor(history, ui);

  function add(preset) {
    const light = presetLight(preset, history.doc.photo.size);
    ui.set({ selected: light.id });
    history.commit({ ...history.doc, lights: [...history.doc.lights, light] });
  }

  let shown = '';
  function update() {
    const lights = history.doc?.lights ?? [];
    menu.disabled = !history.doc;
    empty.hidden = lights.length > 0;
    const { selected } = ui.state;
    // The list is built anew only where it looks different, so that the focus stays while sliders move.
    const looks = JSON.stringify(lights.map(({ id, name, on, solo, blend, tint, shapes }) => [id, name, on, solo, blend, tint, shapes.at(-1)?.color, id === selected]));
    if (looks !== shown) {
      shown = looks;
      const focused = document.activeElement?.closest?.('.lights') ? document.activeElement.dataset.key : null;
      list.replaceChildren(...lights.map((light) => item(light, light.id === selected)).reverse());
      if (focused) list.querySelector(`[data-key="${focused}"]`)?.focus();
    }
    editor.update();
  }

  function item(light, isSelected) {
    const change = (patch) => history.commit(withLight(history.doc, light.id, (one) => ({ ...one, ...patch })));
    const color = light.shapes.findLast((shape) => !shape.erase)?.color ?? [1, 1, 1];
    const chip = el('span', { class: 'chip' });
    chip.style.background = toCss(color.map((c, i) => c * light.tint[i]));
    return el('li', { class: `${isSelected ? 'selected' : ''} ${light.on ? '' : 'muted'}` },
      el('button', { type: 'button', class: 'icon-button', 'aria-label': t.lights.toggle(light.name, light.on), title: light.on ? t.lights.on : t.lights.off, 'aria-pressed': String(light.on), 'data-key': `on${light.id}`, onclick: () => change({ on: !light.on }) }, icon(light.on ? 'on' : 'off')),
      el('button', { type: 'button', class: 'pick', 'aria-pressed': String(isSelected), 'data-key': `pick${light.id}`, onclick: () => ui.set({ selected: light.id }) }, chip, el('span', { class: 'name' }, light.name), el('span', { class: 'blend' }, t.blends[light.blend])),
      el('button', { type: 'button', class: 'solo', 'aria-label': t.lights.soloOf(light.name), title: t.lights.solo, 'aria-pressed': String(light.solo), 'data-key': `solo${light.id}`, onclick: () => change({ solo: !light.solo }) }, 'S'));
  }

  history.addEventListener('change', update);
  ui.addEventListener('change', update);
  update();
  return section(t.lights.title, menu, empty, list, editor.node);
}

function lightEditor(history, ui) {
  const selected = () => history.doc?.lights.find((light) => light.id === ui.state.selected);
  const change = (key, value, done) => {
    history.commit(withLight(history.doc, ui.state.selected, (light) => ({ ...light, [key]: value })), `${key}${ui.state.selected}`);
    if (done) history.settle();
  };
  const name = el('input', { type: 'text', maxLength: 60, 'aria-label': t.lights.name, onchange: () => change('name', name.value.trim() || '…', true) });
  const blend = segmented(t.lights.blend, t.blends, t.blendHints, (value) => change('blend', value, true));
  const strength = slider({ label: t.lights.strength, min: 0, max: 4, step: 0.01, format: (v) => `× ${Math.round(v * 100) / 100}`, onvalue: (value, done) => change('strength', value, done), ticks: [1, 2, 4] });
  // The far end of the slider is "everywhere".
  const reach = slider({
    label: t.lights.reach, min: 0, max: 100, step: 1, format: (v) => (v === null ? t.lights.everywhere : percent(v)), onvalue: (value, done) => change('reach', value, done),
    map: { value: (x) => (x >= 100 ? null : Math.round(1e4 * 0.02 * 40 ** (x / 99)) / 1e4), position: (v) => (v === null ? 100 : Math.min(99, (99 * Math.log(v / 0.02)) / Math.log(40))) },
  });
  const well = el('input', { type: 'color', 'aria-label': t.lights.tint, oninput: () => change('tint', fromHex(well.value), false), onchange: () => history.settle() });
  const tints = Object.entries(TINTS).map(([key, rgb]) => {
    const dot = el('button', { type: 'button', class: 'dot', title: t.tints[key], 'aria-label': `${t.lights.tint}: ${t.tints[key]}`, onclick: () => change('tint', rgb.map((c) => Math.round(c * 1e4) / 1e4), true) });
    dot.style.background = toCss(rgb);
    return dot;
  });
  const move = (step) => {
    const { lights } = history.doc;
    const from = lights.findIndex((light) => light.id === ui.state.selected);
    const to = from + step;
    if (to < 0 || to >= lights.length) return;
    const moved = lights.toSpliced(from, 1).toSpliced(to, 0, lights[from]);
    history.commit({ ...history.doc, lights: moved });
  };
  const copy = () => {
    const light = selected();
    const twin = { ...light, id: newId(), name: t.lights.copyName(light.name) };
    const at = history.doc.lights.indexOf(light) + 1;
    history.commit({ ...history.doc, lights: history.doc.lights.toSpliced(at, 0, twin) });
    ui.set({ selected: twin.id });
  };
  const remove = () => {
    const rest = history.doc.lights.filter((light) => light.id !== ui.state.selected);
    history.commit({ ...history.doc, lights: rest });
    ui.set({ selected: rest.at(-1)?.id ?? null });
  };
  const actions = el('div', { class: 'actions', role: 'toolbar', 'aria-label': t.lights.title },
    iconButton('up', t.lights.up, () => move(1)), iconButton('down', t.lights.down, () => move(-1)), iconButton('copy', t.lights.copy, copy), iconButton('trash', t.lights.remove, remove));
  const node = el('div', { class: 'editor' },
    el('div', { class: 'row' }, name, actions),
    el('div', { class: 'row' }, el('span', { class: 'name' }, t.lights.blend), blend.node),
    strength.node, reach.node,
    el('div', { class: 'row' }, el('span', { class: 'name' }, t.lights.tint), el('div', { class: 'dots' }, tints, well)));
  const update = () => {
    const light = selected();
    node.hidden = !light;
    if (!light) return;
    if (document.activeElement !== name) name.value = light.name;
    blend.show(light.blend);
    strength.show(light.strength);
    reach.show(light.reach);
    well.value = toHex(light.tint);
  };
  return { node, update };
}

/** Histogram, quality, the strength of all lights together. */
export function resultPanel(history, info) {
  const canvas = el('canvas', { class: 'histogram', width: 512, height: 128, role: 'img', 'aria-label': t.result.histogram });
  const clipped = el('p', { class: 'quiet' });
  const change = (key, value, done) => {
    history.commit({ ...history.doc, settings: { ...history.doc.settings, [key]: value } }, key);
    if (done) history.settle();
  };
  const choices = Object.fromEntries(info.presets.map((name) => [name, t.result.presets[name] ?? name]));
  const preset = el('select', { id: 'quality', onchange: () => change('preset', preset.value, true) }, Object.entries(choices).map(([value, text]) => el('option', { value }, text)));
  const intensity = slider({ label: t.result.intensity, min: 0, max: 2, step: 0.01, format: percent, onvalue: (value, done) => change('intensity', value, done) });
  const update = () => {
    preset.value = history.doc?.settings.preset ?? 'reference';
    intensity.show(history.doc?.settings.intensity ?? 1);
    intensity.input.disabled = !history.doc;
  };
  history.addEventListener('change', update);
  update();
  const node = section(t.result.title, canvas, clipped, intensity.node, el('div', { class: 'row' }, el('label', { for: 'quality' }, t.result.preset), preset));
  return { node, canvas, clipped };
}

/** States of the light that are kept, A, B, C ...: {name, doc, bitmap}. */
export function snapshotsPanel(take, restore, compare) {
  let kept = [];
  const list = el('ul', { class: 'snapshots' });
  const none = el('p', { class: 'quiet' }, t.snapshots.none);
  const side = iconButton('columns', t.snapshots.compare, () => compare(kept));
  function update() {
    none.hidden = kept.length > 0;
    side.disabled = kept.length < 2;
    list.replaceChildren(...kept.map((snapshot) => {
      const thumbnail = el('canvas', { width: 144, height: 96, 'aria-hidden': 'true' });
      cover(thumbnail, snapshot.bitmap);
      return el('li', {},
        el('button', { type: 'button', class: 'thumb', 'aria-label': t.snapshots.restore(snapshot.name), title: t.snapshots.restore(snapshot.name), onclick: () => restore(snapshot) }, thumbnail, el('b', {}, snapshot.name)),
        el('button', { type: 'button', class: 'remove', 'aria-label': t.snapshots.remove(snapshot.name), onclick: () => {
          kept = kept.filter((one) => one !== snapshot);
          update();
        } }, icon('close')));
    }));
  }
  const add = () => {
    const snapshot = take();
    if (!snapshot) return;
    const used = new Set(kept.map(({ name }) => name));
    const name = [...'ABCDEFGHIJKLMNOPQRSTUVWXYZ'].find((letter) => !used.has(letter)) ?? 'Z';
    kept = [...kept, { ...snapshot, name }];
    update();
  };
  update();
  const node = section(t.snapshots.title, el('div', { class: 'panel-actions' }, iconButton('camera', t.snapshots.take, add), side), none, list);
  return { node, clear: () => {
    kept = [];
    update();
  } };
}

/** Fill a canvas with the middle of a picture. */
function cover(canvas, bitmap) {
  const scale = Math.max(canvas.width / bitmap.width, canvas.height / bitmap.height);
  const [width, height] = [canvas.width / scale, canvas.height / scale];
  canvas.getContext('2d').drawImage(bitmap, (bitmap.width - width) / 2, (bitmap.height - height) / 2, width, height, 0, 0, canvas.width, canvas.height);
}
