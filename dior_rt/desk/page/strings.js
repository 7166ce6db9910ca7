// Every word that the page shows. To translate the desk, translate this file.

export const t = {
  title: 'Light desk',
  stage: 'Photo. Draw light here; arrow keys pan, plus and minus zoom.',
  tools: {
    label: 'Tools',
    brush: 'Brush', eraser: 'Eraser', lasso: 'Lasso fill', gradient: 'Gradient', glow: 'Glow',
    picker: 'Pick a colour from the photo', hand: 'Pan',
  },
  toolHints: {
    brush: 'Draw light. Shift draws a straight line.',
    eraser: 'Take drawn light away from the selected light.',
    lasso: 'Draw an outline; it is filled with light.',
    gradient: 'Drag from full light to none.',
    glow: 'Drag from the middle of a soft pool of light to its border.',
    picker: 'Click the photo to take its colour.',
    hand: 'Drag to move the photo.',
  },
  bar: {
    open: 'Open', openHint: 'Open a photo or a project', save: 'Save', saveHint: 'Save the project as a file',
    undo: 'Undo', redo: 'Redo', relight: 'Relight', relightHint: 'Compute the full result, at the photo’s size',
    cancel: 'Cancel', export: 'Export', help: 'Keyboard shortcuts', theme: 'Light or dark',
    view: 'View', overlay: 'Overlay', fit: 'Fit', rotate: 'Rotate view', fullscreen: 'Full screen',
  },
  views: { relit: 'Relit', photo: 'Photo', split: 'Compare' },
  overlays: { none: 'None', drawn: 'Drawn', source: 'Source map', target: 'Target map', clip: 'Clipping' },
  overlayHints: {
    none: 'Only the picture', drawn: 'The light that is drawn, over the picture',
    source: 'The light that the model sees on the photo', target: 'The light that is asked for',
    clip: 'Red: too bright to show. Blue: black.',
  },
  split: 'Divider between photo and result',
  scale: 'Light; 1 shows white paper as white',
  brush: {
    title: 'Brush', size: 'Size', softness: 'Softness', flow: 'Flow',
    pressure: 'Pen pressure', thins: 'Width', fades: 'Strength',
  },
  color: {
    title: 'Colour', kelvin: 'Warmth', hue: 'Hue', saturation: 'Saturation', strength: 'Strength',
    swap: 'Swap colours', current: 'Colour of the brush', other: 'Other colour',
  },
  lights: {
    title: 'Lights', add: 'Add a light', list: 'Lights, the top one last', none: 'No lights yet. Draw on the photo, or add one.',
    on: 'On', off: 'Off', solo: 'Solo', up: 'Move up', down: 'Move down', copy: 'Duplicate', remove: 'Delete',
    name: 'Name', blend: 'Blend', strength: 'Strength', tint: 'Tint', reach: 'Reach', everywhere: 'all',
    newName: (n) => `Light ${n}`, copyName: (name) => `${name} copy`,
    toggle: (name, on) => `${name}: ${on ? 'on' : 'off'}`, soloOf: (name) => `Solo ${name}`,
  },
  blends: { add: 'Add', set: 'Set', multiply: 'Multiply' },
  blendHints: {
    add: 'One more lamp; it never darkens', set: 'The light here is exactly this',
    multiply: 'A flag or a gel: times the light on the photo',
  },
  tints: { white: 'Neutral', candle: 'Candle', tungsten: 'Tungsten', shade: 'Shade', moon: 'Moon' },
  presets: {
    blank: 'Blank light', key: 'Key light', fill: 'Fill light', rim: 'Rim light', windowLeft: 'Window, left', windowRight: 'Window, right',
    candle: 'Candle', sunset: 'Sunset', moonlight: 'Moonlight', background: 'Darken background', around: 'Light all round',
  },
  result: {
    title: 'Result', histogram: 'Histogram of the picture shown', clipped: (bright, dark) => `${bright} bright, ${dark} black`,
    preset: 'Quality', intensity: 'All lights', seed: 'Seed',
    presets: { reference: 'Reference', balanced: 'Balanced', fast: 'Fast' },
  },
  snapshots: {
    title: 'Snapshots', take: 'Take a snapshot', compare: 'Side by side', restore: (name) => `Restore snapshot ${name}`,
    remove: (name) => `Delete snapshot ${name}`, none: 'Keep states of the light, and compare them.', close: 'Close',
  },
  exports: {
    title: 'Export', photo: 'Picture, full size', layers: 'Lights as layers', command: 'Command line',
    formats: { png: 'PNG', tiff: 'TIFF', jpeg: 'JPEG', webp: 'WebP' },
    layerFormats: { ora: 'OpenRaster (Krita, GIMP)', exr: 'OpenEXR', png: 'PNG files (zip)' },
    depth: (bits) => `PNG and TIFF keep the photo’s ${bits} bits a channel.`,
    copy: 'Copy', copied: 'Copied.', close: 'Close',
    commandHint: 'Save the project, then this command makes the same file:',
  },
  status: {
    loading: 'Loading the model', opening: (name) => `Opening ${name}`, empty: 'Drop a photo here',
    choose: 'Choose a photo', formats: 'PNG, JPEG, TIFF, WebP, or a .dior project with its photo', privacy: 'Photos stay on this machine.',
    preview: (ms) => `Preview ${ms} ms`, previewing: 'Preview…', queued: (n) => (n ? `Waiting for ${n} more` : 'Waiting'),
    steps: (step, steps) => `Step ${step} of ${steps}`, done: 'Relit at full size', cancelled: 'Cancelled',
    saved: 'Saved in this browser', lost: 'The desk does not answer. Is dior-rt still running?',
    reopen: (name) => `Open ${name} again to go on with its lights.`,
    otherPhoto: (name) => `This project was drawn on ${name}. Open that photo, then the project.`,
    restored: 'Your last lights on this photo are back.', model: (model, device) => `${model} on ${device}`, unsaved: 'This browser cannot keep the drawing; save the project as a file.',
  },
  help: {
    title: 'Keyboard shortcuts', close: 'Close',
    keys: [
      ['B E L G O I H', 'Brush, eraser, lasso, gradient, glow, pick a colour, pan'], ['[  ]', 'Brush size'], ['Shift [  ]', 'Brush softness'], ['X', 'Swap colours'],
      ['Space', 'Hold to pan'], ['+  −  0  1', 'Zoom in, out, fit, 100 %'], ['R', 'Rotate the view'], ['F', 'Full screen'],
      ['\\', 'Photo or result'], ['C', 'Compare'], ['D  S  T  W', 'Drawn light, source map, target map, clipping warning'],
      ['M', 'Selected light on or off'], ['Enter', 'Relight'], ['Ctrl Z, Ctrl Shift Z', 'Undo, redo'], ['Ctrl S', 'Save the project'], ['Ctrl O', 'Open'],
    ],
  },
};
