// Keyboard shortcuts. Keys are those of the character that is typed, so they follow the keyboard's layout.

/** commands: name -> function; see the table. Fields and open dialogs keep their keys. */
export function bindKeys(commands) {
  const plain = {
    b: ['tool', 'brush'], e: ['tool', 'eraser'], l: ['tool', 'lasso'], g: ['tool', 'gradient'], o: ['tool', 'glow'], i: ['tool', 'picker'], h: ['tool', 'hand'],
    '[': ['size', -1], ']': ['size', 1], '{': ['soft', -1], '}': ['soft', 1], x: ['swap'], '+': ['zoom', 1.25], '=': ['zoom', 1.25], '-': ['zoom', 0.8], 0: ['fit'], 1: ['actual'],
    r: ['rotate'], f: ['fullscreen'], '\\': ['view', 'photo'], c: ['view', 'split'], d: ['overlay', 'drawn'], s: ['overlay', 'source'], t: ['overlay', 'target'], w: ['overlay', 'clip'],
    m: ['mute'], '?': ['help'],
  };
  const withControl = { z: ['undo'], y: ['redo'], s: ['save'], o: ['open'] };
  document.addEventListener('keydown', (event) => {
    const { target } = event;
    const isField = target.matches?.('input:not([type=range]):not([type=checkbox]):not([type=color]), select, textarea') || document.querySelector('dialog[open]');
    if (isField || event.altKey) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const control = event.ctrlKey || event.metaKey;
    let found = control ? withControl[key] : plain[key];
    if (control && key === 'z' && event.shiftKey) found = ['redo'];
    const onStage = target === document.body || target.matches?.('.stage canvas');
    if (!control && key === 'Enter' && onStage) found = ['relight'];
    if (!control && key.startsWith('Arrow') && onStage) found = ['pan', key.slice(5)];
    if (!control && key === ' ' && onStage) found = ['space', true];
    if (!found) return;
    event.preventDefault();
    commands[found[0]](found[1]);
  });
  document.addEventListener('keyup', (event) => event.key === ' ' && commands.space(false));
  window.addEventListener('blur', () => commands.space(false));
}
