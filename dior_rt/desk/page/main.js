// The desk: builds the page and joins its parts.

import { HttpBackend } from './backend.js';
import { compareDialog, exportDialog, helpDialog } from './dialogs.js';
import { download, el, icon, iconButton, segmented } from './dom.js';
import { analyse, drawHistogram } from './histogram.js';
import { bindKeys } from './keys.js';
import { drawScale, mapCanvas, scaleLabels } from './maps.js';
import { fromProject, History, newDocument, newLight, nextName, toProject, Ui, withShape } from './model.js';
import { brushPanel, colorPanel, lightsPanel, resultPanel, snapshotsPanel } from './panels.js';
import { Previewer } from './previewer.js';
import { Stage } from './stage.js';
import { Store } from './store.js';
import { t } from './strings.js';
import { Tools } from './tools.js';
import { View } from './view.js';

const PICTURE = 2048; // pixels of the longer side of what the stage shows

const backend = new HttpBackend();
const history = new History();
const ui = new Ui();
const view = new View();
const store = new Store();

let photo = null; // what the back end says of the photo
let result = null; // {job, doc} of the newest full result
let running = null; // the full result under way
let info = null;

document.title = t.title;

// The frame of the page

const status = el('span', { class: 'said', role: 'status' });
const timing = el('span', { class: 'timing' });
const zoomLabel = el('span', { class: 'zoom' });
const progress = el('progress', { max: 1, value: 0, hidden: true, 'aria-label': t.bar.relight });
const relightButton = el('button', { type: 'button', class: 'primary', title: `${t.bar.relightHint} (Enter)`, onclick: () => (running ? running.cancel() : relight()) }, t.bar.relight);
const exportButton = el('button', { type: 'button', onclick: openExport }, t.bar.export);
const undoButton = iconButton('undo', t.bar.undo, () => history.undo());
const redoButton = iconButton('redo', t.bar.redo, () => history.redo());
const saveButton = el('button', { type: 'button', title: `${t.bar.saveHint} (Ctrl S)`, onclick: saveProject }, t.bar.save);
const picker = el('input', { type: 'file', accept: 'image/*,.dior', multiple: true, hidden: true, 'aria-label': t.bar.openHint, onchange: () => {
  openFiles([...picker.files]);
  picker.value = '';
} });
const photoName = el('span', { class: 'photo-name' });
const views = segmented(t.bar.view, t.views, null, (value) => ui.set({ view: value }));
const overlays = segmented(t.bar.overlay, t.overlays, t.overlayHints, (value) => ui.set({ overlay: value }));

const canvas = el('canvas', { tabIndex: 0, role: 'application', 'aria-label': t.stage });
const divider = el('div', { class: 'divider', role: 'slider', tabIndex: 0, 'aria-label': t.split, 'aria-valuemin': '0', 'aria-valuemax': '100' });
const legend = legendOf();
const empty = el('div', { class: 'empty' }, icon('glow'), el('h2', {}, t.status.empty), el('button', { type: 'button', class: 'primary', onclick: () => picker.click() }, t.status.choose), el('p', {}, t.status.formats), el('p', {}, t.status.privacy));
const main = el('main', { class: 'stage' }, canvas, divider, legend, empty);

const toolButtons = ['brush', 'eraser', 'lasso', 'gradient', 'glow', 'picker', 'hand'].map((name) =>
  el('button', { type: 'button', class: 'tool', title: `${t.tools[name]}: ${t.toolHints[name]}`, 'aria-label': t.tools[name], 'aria-pressed': 'false', 'data-tool': name, onclick: () => ui.set({ tool: name }) }, icon(name)));
const toolbar = el('div', { class: 'tools', role: 'toolbar', 'aria-label': t.tools.label, 'aria-orientation': 'vertical' }, toolButtons, el('span', { class: 'gap' }),
  iconButton('fit', t.bar.fit, () => stage.fit()), iconButton('rotate', t.bar.rotate, rotate), iconButton('full', t.bar.fullscreen, fullscreen), iconButton('help', t.bar.help, helpDialog), iconButton('theme', t.bar.theme, switchTheme));

const header = el('header', { class: 'bar' },
  el('div', { class: 'group' }, el('h1', { class: 'brand' }, icon('glow'), t.title), el('button', { type: 'button', title: `${t.bar.openHint} (Ctrl O)`, onclick: () => picker.click() }, t.bar.open), saveButton, picker, undoButton, redoButton),
  photoName,
  el('div', { class: 'group' }, views.node, overlays.node),
  el('div', { class: 'group' }, progress, relightButton, exportButton));
const side = el('aside', { class: 'side', 'aria-label': t.lights.title });
document.body.append(header, el('nav', { 'aria-label': t.tools.label }, toolbar), main, side, el('footer', { class: 'foot' }, status, timing, zoomLabel));

const stage = new Stage(canvas, view, history, ui, refreshView);
const tools = new Tools({
  stage, view, ui, history,
  live: (shape, tool) => {
    stage.live = shape;
    if (shape && tool !== 'lasso') previewer.ask(photo.id, toProject(drawn(shape).doc), true);
    stage.refresh();
  },
  draw: (shape) => {
    const { doc, selected } = drawn(shape);
    stage.ghost = shape;
    if (selected !== ui.state.selected) ui.set({ selected });
    history.commit(doc);
  },
  pick: (color) => ui.set({ color: { ...ui.state.color, ...color }, tool: 'brush' }),
  moved: () => {
    stage.fitted = false;
    refreshView();
  },
});

/** The document with a shape on the selected light, or on a new light where none is selected. */
function drawn(shape) {
  const { doc } = history;
  const known = doc.lights.some((light) => light.id === ui.state.selected);
  if (known || shape.erase) return { doc: withShape(doc, ui.state.selected, shape), selected: ui.state.selected };
  const light = newLight({ name: nextName(doc), shapes: [shape] });
  return { doc: { ...doc, lights: [...doc.lights, light] }, selected: light.id };
}

// What is seen

const previewer = new Previewer(backend, showPreview, (busy) => main.classList.toggle('busy', busy));

async function showPreview({ blob, asked, fine, error }) {
  if (error) return say(error.message, true);
  const bitmap = await createImageBitmap(blob);
  if (!stage.live) stage.ghost = null;
  setRelit(bitmap);
  const milliseconds = Math.round(performance.now() - asked);
  timing.textContent = t.status.preview(milliseconds);
  count('previews');
  if (fine) {
    document.documentElement.dataset.milliseconds = milliseconds;
    count('fine');
  }
}

/** Count an event where programs that drive the page can see it. */
function count(name) {
  const { dataset } = document.documentElement;
  dataset[name] = Number(dataset[name] ?? 0) + 1;
}

function setRelit(bitmap) {
  stage.relit = bitmap;
  const analysis = analyse(bitmap ?? stage.photo);
  stage.clipped = analysis.clipped;
  panels.result.clipped.textContent = t.result.clipped(share(analysis.bright), share(analysis.dark));
  drawHistogram(panels.result.canvas, analysis);
  stage.refresh();
}

const share = (x) => `${(100 * x).toFixed(x < 0.1 ? 1 : 0)}%`;

function refreshView() {
  zoomLabel.textContent = `${Math.round(100 * view.scale)}%`;
  stage.refresh();
}

let mapNumber = 0;
async function updateMap() {
  const { overlay } = ui.state;
  const number = ++mapNumber;
  legend.hidden = !['source', 'target'].includes(overlay);
  if (legend.hidden || !photo) return;
  try {
    const raster = overlay === 'source' ? await backend.source(photo.id) : await backend.target(photo.id, toProject(history.doc));
    if (number !== mapNumber) return;
    // With no lights nothing is asked for, and the target is what is there.
    stage.map = mapCanvas(raster);
    stage.refresh();
  } catch (error) {
    say(error.message, true);
  }
}

function legendOf() {
  const ramp = el('canvas', { width: 256, height: 1, 'aria-hidden': 'true' });
  drawScale(ramp);
  const labels = scaleLabels().map(([text, at]) => {
    const label = el('span', {}, text);
    label.style.left = `${100 * at}%`;
    return label;
  });
  return el('div', { class: 'legend', hidden: true }, el('p', {}, t.scale), ramp, el('div', { class: 'labels' }, labels));
}

// Changes

history.addEventListener('change', () => {
  undoButton.disabled = !history.canUndo;
  redoButton.disabled = !history.canRedo;
  saveButton.disabled = exportButton.disabled = relightButton.disabled = !history.doc;
  if (!history.doc) return;
  const isResult = result?.doc === history.doc;
  if (!isResult) previewer.ask(photo.id, toProject(history.doc));
  if (ui.state.overlay === 'target') updateMap();
  remember();
  stage.refresh();
});

ui.addEventListener('change', () => {
  const { state } = ui;
  toolButtons.forEach((button) => button.setAttribute('aria-pressed', String(button.dataset.tool === state.tool)));
  views.show(state.view);
  overlays.show(state.overlay);
  main.dataset.tool = state.tool;
  divider.hidden = state.view !== 'split' || !history.doc;
  divider.style.left = `${100 * state.split}%`;
  divider.setAttribute('aria-valuenow', String(Math.round(100 * state.split)));
  if (state.overlay !== main.dataset.overlay) {
    main.dataset.overlay = state.overlay;
    stage.map = null;
    updateMap();
  }
  remember();
  stage.refresh();
});

function remember() {
  if (!history.doc) return;
  store.save({ doc: history.doc, ui: ui.state, id: photo.id, name: photo.name }, (error) => {
    document.documentElement.dataset.saved = String(!error);
    if (error) say(t.status.unsaved, true);
  });
}

function say(text, isError = false) {
  status.textContent = text;
  status.classList.toggle('error', isError);
}

const swap = () => ui.set({ color: ui.state.other, other: ui.state.color });

// Photos and projects

async function openFiles(files) {
  const projects = files.filter((file) => file.name.toLowerCase().endsWith('.dior'));
  const [picture] = files.filter((file) => !projects.includes(file));
  try {
    if (picture) await openPhoto(picture);
    if (projects.length) await openProject(projects[0]);
  } catch (error) {
    main.classList.remove('opening');
    say(error.message, true);
  }
}

async function openPhoto(file) {
  say(t.status.opening(file.name));
  main.classList.add('opening');
  const opened = await backend.open(file);
  await store.begin(file);
  await show(opened, newDocument(opened));
}

async function openProject(file) {
  const doc = fromProject(await backend.unpack(file));
  const fits = photo && String(photo.size) === String(doc.photo.size);
  if (!fits) return say(t.status.otherPhoto(doc.photo.name || `${doc.photo.size.join(' × ')}`), true);
  ui.set({ selected: doc.lights.at(-1)?.id ?? null });
  history.commit({ ...doc, photo: history.doc.photo });
}

/** Put a photo on the stage, with a document that belongs to it. */
async function show(opened, doc, said = opened.notices.join(' ')) {
  previewer.drop();
  const bitmap = await createImageBitmap(await backend.picture(opened.id, PICTURE));
  photo = opened;
  result = null;
  Object.assign(stage, { photo: bitmap, relit: null, live: null, ghost: null, map: null });
  previewer.finest = Math.min(PICTURE, Math.max(...opened.size));
  photoName.textContent = opened.name;
  photoName.title = `${opened.name}, ${opened.size.join(' × ')}`;
  empty.hidden = true;
  main.classList.remove('opening');
  setRelit(null);
  panels.snapshots.clear();
  history.reset(doc);
  stage.fit();
  ui.set({});
  updateMap();
  say(said);
  document.documentElement.dataset.photo = opened.id;
}

async function saveProject() {
  if (!history.doc) return;
  download(await backend.pack(toProject(history.doc)), `${stem()}.dior`);
}

const stem = () => photo.name.replace(/\.[^.]*$/, '');

// The full result

async function relight() {
  if (!history.doc || running) return;
  const { doc } = history;
  relightButton.textContent = t.bar.cancel;
  Object.assign(progress, { hidden: false, value: 0 });
  running = backend.relight(photo.id, toProject(doc), (state) => {
    if (state.stage === 'queued') say(t.status.queued(state.ahead));
    else if (state.steps) {
      progress.value = state.step / state.steps;
      say(t.status.steps(state.step, state.steps));
    }
  });
  try {
    const job = await running.done;
    if (!job) return say(t.status.cancelled);
    result = { job, doc };
    if (history.doc === doc) {
      previewer.drop();
      setRelit(await createImageBitmap(await backend.result(job, PICTURE)));
    }
    say(t.status.done);
  } catch (error) {
    say(error.message, true);
  } finally {
    running = null;
    relightButton.textContent = t.bar.relight;
    progress.hidden = true;
  }
}

/** The job of a full result of the document as it is; computes it where there is none. */
async function currentResult() {
  if (result?.doc !== history.doc) await relight();
  return result?.doc === history.doc ? result.job : null;
}

function openExport() {
  const name = stem();
  exportDialog({
    bits: photo.bits, transparent: photo.transparent, hasLights: history.doc.lights.length > 0,
    command: `dior-rt relight ${quoted(photo.name)} ${quoted(`${name}.dior`)} -o ${quoted(`${name}-relit.png`)}`,
    save: attempt(async (kind) => {
      const job = await currentResult();
      if (job) download(await backend.file(job, kind), `${name}-relit.${{ jpeg: 'jpg', tiff: 'tif' }[kind] ?? kind}`);
    }),
    layers: attempt(async (kind) => download(await backend.layers(photo.id, toProject(history.doc), kind), `${name}-lights.${kind === 'png' ? 'zip' : kind}`)),
  });
}

const quoted = (name) => (/^[\w.\-+]+$/.test(name) ? name : `'${name.replaceAll("'", "'\\''")}'`);

const attempt = (work) => async (...args) => {
  try {
    await work(...args);
  } catch (error) {
    say(error.message, true);
  }
};

// Commands

function rotate() {
  if (!history.doc) return;
  view.rotate(90, history.doc.photo.size, stage.box);
  refreshView();
}

function fullscreen() {
  return document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen();
}

function switchTheme() {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === 'dark' : matchMedia('(prefers-color-scheme: dark)').matches;
  root.dataset.theme = dark ? 'light' : 'dark';
  localStorage.setItem('theme', root.dataset.theme);
}

const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
const toggled = (key, value, rest) => ui.set({ [key]: ui.state[key] === value ? rest : value });
const zoomMiddle = (factor) => {
  view.zoom(factor, stage.box.width / 2, stage.box.height / 2);
  stage.fitted = false;
  refreshView();
};

bindKeys({
  tool: (tool) => ui.set({ tool }),
  size: (step) => ui.set({ size: clamp(ui.state.size * 1.15 ** step, 0.004, 0.5) }),
  soft: (step) => ui.set({ softness: clamp(ui.state.softness + step / 10, 0, 1) }),
  swap,
  zoom: zoomMiddle,
  fit: () => history.doc && stage.fit(),
  actual: () => zoomMiddle(1 / view.scale),
  rotate, fullscreen,
  view: (name) => toggled('view', name, 'relit'),
  overlay: (name) => toggled('overlay', name, 'none'),
  mute: () => {
    const light = history.doc?.lights.find(({ id }) => id === ui.state.selected);
    if (light) history.commit({ ...history.doc, lights: history.doc.lights.map((one) => (one === light ? { ...one, on: !one.on } : one)) });
  },
  relight, help: helpDialog,
  undo: () => history.undo(), redo: () => history.redo(), save: saveProject, open: () => picker.click(),
  pan: (way) => {
    view.pan({ Left: 40, Right: -40 }[way] ?? 0, { Up: 40, Down: -40 }[way] ?? 0);
    refreshView();
  },
  space: (held) => {
    tools.spaceHeld = held;
    main.classList.toggle('panning', held);
  },
});

divider.addEventListener('pointerdown', (event) => divider.setPointerCapture(event.pointerId));
divider.addEventListener('pointermove', (event) => {
  if (divider.hasPointerCapture(event.pointerId)) ui.set({ split: clamp((event.clientX - stage.box.left) / stage.box.width, 0, 1) });
});
divider.addEventListener('keydown', (event) => {
  const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
  if (!step) return;
  event.preventDefault();
  event.stopPropagation();
  ui.set({ split: clamp(ui.state.split + step, 0, 1) });
});

for (const name of ['dragover', 'drop']) {
  document.addEventListener(name, (event) => {
    event.preventDefault();
    if (name === 'drop') openFiles([...event.dataTransfer.files]);
  });
}

// The start

const panels = {};

async function start() {
  document.documentElement.dataset.theme = localStorage.getItem('theme') ?? '';
  say(t.status.loading);
  main.classList.add('opening');
  info = await backend.info();
  panels.result = resultPanel(history, info);
  panels.snapshots = snapshotsPanel(
    () => history.doc && { doc: history.doc, bitmap: stage.relit ?? stage.photo },
    ({ doc }) => history.commit(doc),
    compareDialog,
  );
  side.append(colorPanel(ui, swap), brushPanel(ui), lightsPanel(history, ui), panels.result.node, panels.snapshots.node);
  ui.set({});
  const first = info.photo ? await backend.openFirst() : null;
  const kept = await store.resume((record) => !first || record.id === first.id).catch(() => null);
  if (kept) await resume(kept, first);
  else if (first) {
    await store.begin(null);
    await show(first, newDocument(first));
  }
  main.classList.remove('opening');
  if (!history.doc && !status.classList.contains('error')) say(t.status.model(info.model, info.device));
  document.documentElement.dataset.ready = 'true';
}

/** Take up what was drawn before: the photo is still open, or in the browser, or the command line's. */
async function resume({ record, photo: kept }, first) {
  let opened = record.id === first?.id ? first : await backend.find(record.id);
  if (!opened && kept) opened = await backend.open(kept, record.name);
  if (!opened) return say(t.status.reopen(record.name), true);
  await show(opened, record.doc, t.status.restored);
  ui.set(record.ui);
}

start().catch((error) => {
  main.classList.remove('opening');
  say(error.message, true);
});
