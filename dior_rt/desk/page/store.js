// Autosave: each tab keeps its drawing in IndexedDB, in a slot of its own that it holds a lock on. The photo lies
// beside it and is written once.

const DATABASE = 'dior-desk';
const MOST_SLOTS = 8;
const PATIENCE = 2000; // milliseconds until the page before a reload has let go of its slot

// The path holds the desk's token: another run of the desk is not a reload.
const MINE = `${DATABASE}${location.pathname}`;

let opening = null;

function database() {
  opening ??= new Promise((resolve, reject) => {
    const request = indexedDB.open(DATABASE, 1);
    request.onupgradeneeded = () => ['slots', 'photos'].forEach((name) => request.result.createObjectStore(name, { keyPath: 'slot' }));
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
  return opening;
}

/** One request to a store ("slots" or "photos"), and its answer. */
async function ask(name, mode, work) {
  const transaction = (await database()).transaction(name, mode);
  const request = work(transaction.objectStore(name));
  return new Promise((resolve, reject) => {
    transaction.oncomplete = () => resolve(request.result);
    transaction.onerror = transaction.onabort = () => reject(transaction.error);
  });
}

/** Take the slot's lock for as long as the tab lives; false where another tab has it. */
function hold(slot, options) {
  return new Promise((resolve) => {
    const held = (lock) => {
      resolve(Boolean(lock));
      return lock ? new Promise(() => {}) : null;
    };
    navigator.locks.request(`${DATABASE}/${slot}`, options, held).catch(() => resolve(false));
  });
}

const newestFirst = async () => (await ask('slots', 'readonly', (store) => store.getAll())).sort((a, b) => b.saved - a.saved);

export class Store {
  #slot = null;
  #timer = 0;

  /** Take up this tab's slot again after a reload, or the newest free one that fits; {record, photo} or null. */
  async resume(fits) {
    const records = await newestFirst();
    const reloaded = records.find((record) => record.slot === sessionStorage.getItem(MINE));
    const held = reloaded && (await hold(reloaded.slot, { signal: AbortSignal.timeout(PATIENCE) }));
    for (const record of held ? [reloaded] : records.filter(fits)) {
      if (held || (await hold(record.slot, { ifAvailable: true }))) {
        this.#take(record.slot);
        const kept = await ask('photos', 'readonly', (store) => store.get(record.slot));
        return { record, photo: kept?.photo ?? null };
      }
    }
    return null;
  }

  /** Begin a new slot, for another photo. photo: its File, or null where the server has it anyway. */
  async begin(photo) {
    const slot = crypto.randomUUID();
    await hold(slot, {});
    this.#take(slot);
    if (photo) await ask('photos', 'readwrite', (store) => store.put({ slot, photo })).catch(() => {});
  }

  /** Save soon; later calls take the place of earlier ones. onsaved gets an error, or null. */
  save(state, onsaved) {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#write(state).then(() => onsaved(null), onsaved), 300);
  }

  async #write(state) {
    if (!this.#slot) return;
    await ask('slots', 'readwrite', (store) => store.put({ ...state, slot: this.#slot, saved: Date.now() }));
    for (const { slot } of (await newestFirst()).slice(MOST_SLOTS)) {
      for (const name of ['slots', 'photos']) await ask(name, 'readwrite', (store) => store.delete(slot));
    }
  }

  #take(slot) {
    this.#slot = slot;
    sessionStorage.setItem(MINE, slot);
  }
}
