// What computes light for the page. The page knows this interface only; this back end speaks to the server beside it.
//
//   info()                            the model and its presets
//   open(file) / openFirst()          a photo -> {id, name, size: [width, height], bits, notices}
//   find(id)                          the same for a photo that is still open, or null
//   picture(id, longest)              Blob of the photo
//   preview(id, project, longest)     Blob of the photo under the lights; null where a newer one was asked for
//   source(id), target(id, project)   {rows, columns, channels, data: Float32Array}
//   relight(id, project, onstate)     {done: Promise<job>, cancel()}
//   result(job, longest), file(job, kind), layers(id, project, kind), pack(project), unpack(file)

import { t } from './strings.js';

export class BackendError extends Error {
  constructor(message, status = 0) {
    super(message);
    this.status = status;
  }
}

export class HttpBackend {
  #page = crypto.randomUUID();
  #number = 0;

  info() {
    return this.#json('api/desk');
  }

  open(file, name) {
    return this.#json(`api/photos?name=${encodeURIComponent(name ?? file.name)}`, { method: 'POST', body: file });
  }

  openFirst() {
    return this.#json('api/photos/first', { method: 'POST' });
  }

  async find(id) {
    try {
      return await this.#json(`api/photos/${id}`);
    } catch (error) {
      if (error.status === 404) return null;
      throw error;
    }
  }

  picture(id, longest) {
    return this.#blob(`api/photos/${id}/picture?longest=${longest}`);
  }

  async preview(id, project, longest) {
    const number = ++this.#number;
    const response = await this.#call(`api/photos/${id}/preview?page=${this.#page}&number=${number}&longest=${longest}`, post(project));
    return response.status === 204 ? null : response.blob();
  }

  source(id) {
    return this.#raster(`api/photos/${id}/source`);
  }

  target(id, project) {
    return this.#raster(`api/photos/${id}/target`, post(project));
  }

  relight(id, project, onstate) {
    let job = null;
    let cancelled = false;
    const follow = async () => {
      ({ job } = await this.#json(`api/photos/${id}/jobs`, post(project)));
      if (cancelled) await this.#call(`api/jobs/${job}`, { method: 'DELETE' });
      for await (const state of events(await this.#call(`api/jobs/${job}/events`))) {
        onstate(state);
        if (state.stage === 'failed') throw new BackendError(state.message);
        if (state.stage === 'cancelled') return null;
      }
      return job;
    };
    const cancel = () => {
      cancelled = true;
      if (job) this.#call(`api/jobs/${job}`, { method: 'DELETE' }).catch(() => {});
    };
    return { done: follow(), cancel };
  }

  result(job, longest) {
    return this.#blob(`api/jobs/${job}/picture?longest=${longest}`);
  }

  file(job, kind) {
    return this.#blob(`api/jobs/${job}/file?kind=${kind}`);
  }

  layers(id, project, kind) {
    return this.#blob(`api/photos/${id}/layers?kind=${kind}`, post(project));
  }

  pack(project) {
    return this.#blob('api/projects/pack', post(project));
  }

  unpack(file) {
    return this.#json('api/projects/unpack', { method: 'POST', body: file });
  }

  async #call(path, options) {
    let response;
    try {
      response = await fetch(path, options);
    } catch {
      throw new BackendError(t.status.lost);
    }
    if (!response.ok) {
      const said = await response.json().catch(() => ({}));
      throw new BackendError(said.error ?? response.statusText, response.status);
    }
    return response;
  }

  async #json(path, options) {
    return (await this.#call(path, options)).json();
  }

  async #blob(path, options) {
    return (await this.#call(path, options)).blob();
  }

  async #raster(path, options) {
    const response = await this.#call(path, options);
    const [rows, columns, channels] = response.headers.get('X-Shape').split(' ').map(Number);
    return { rows, columns, channels, data: new Float32Array(await response.arrayBuffer()) };
  }
}

const post = (project) => ({ method: 'POST', body: JSON.stringify(project) });

/** The data of server-sent events, parsed. */
async function* events(response) {
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = '';
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text += value;
    const parts = text.split('\n\n');
    text = parts.pop();
    for (const part of parts) if (part.startsWith('data: ')) yield JSON.parse(part.slice(6));
  }
}
