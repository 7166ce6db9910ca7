// Autosave: each tab keeps its drawing in IndexedDB, in a slot of its own that it holds a lock on.

const DATABASE = 'dior-desk';
const STORE = 'slots';
const MOST_SLOTS = 8;

let opening = null;

function database() {
  opening ??= new Promise((resolve, reject) => {
    const request = indexedDB.open(DATABASE, 1);
    request.onupgradeneeded = () => request.result.createObjectStore(STORE, { keyPath: 'slot' });
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
  return opening;
}

async function ask(mode, work) {
  const transaction = (await database()).transaction(STORE, mode);
  const request = work(transaction.objectStore(STORE));
  return new Promise((resolve, reject) => {
    transaction.oncomplete = () => resolve(request.result);
    transaction.onerror = transaction.onabort = () => reject(transaction.error);
  });
}

/** Take the slot's lock for as long as the tab lives; false where another tab has it. */
function hold(slot) {
  return new Promise((resolve) => {
    navigator.locks.request(`${DATABASE}/${slot}`, { ifAvailable: true }, (lock) => {
      resolve(Boolean(lock));
      return lock ? new Promise(() => {}) : null;
    });
  });
}

export class Store {
  #slot = null;
  #photo = null;
  #timer = 0;

  /** Take up this tab's slot again after a reload, or the newest free one that fits; its record or null. */
  async resume(fits) {
    const records = (await ask('readonly', (store) => store.getAll())).sort((a, b) => b.saved - a.saved);
    const mine = sessionStorage.getItem(DATABASE);
    const reloaded = records.find((record) => record.slot === mine);
    for (const record of reloaded ? [reloaded] : records.filter(fits)) {
      if (await hold(record.slot)) {
        this.#take(record.slot);
        this.#photo = record.photo;
        return record;
      }
    }
    return null;
  }

  /** Begin a new slot, for another photo. photo: its File, or null where the server has it anyway. */
  async begin(photo) {
    const slot = crypto.randomUUID();
    await hold(slot);
    this.#take(slot);
    this.#photo = photo;
  }

  /** Save soon; later calls take the place of earlier ones. */
  save(state, onsaved) {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#write(state).then(() => onsaved(null), onsaved), 300);
  }

  async #write(state) {
    if (!this.#slot) return;
    await ask('readwrite', (store) => store.put({ ...state, slot: this.#slot, photo: this.#photo, saved: Date.now() }));
    const slots = (await ask('readonly', (store) => store.getAll())).sort((a, b) => b.saved - a.saved);
    for (const { slot } of slots.slice(MOST_SLOTS)) await ask('readwrite', (store) => store.delete(slot));
  }

  #take(slot) {
    this.#slot = slot;
    sessionStorage.setItem(DATABASE, slot);
  }
}
