// Regions marked data-live are taken anew from the page itself, so that one template draws them.

const PROBLEM = 'application/problem+json';

/** The best run of a sweep has become another one: all that is shown of a run is taken from it. */
function takeRun(fresh) {
  const [shown, next] = [document, fresh].map((one) => one.getElementById('run'));
  if (shown && next && shown.dataset.run !== next.dataset.run) shown.replaceWith(document.adoptNode(next.cloneNode(true)));
}

const pageNow = latest(() => ask(location.href, { headers: { Accept: 'text/html' } }));

/**
 * Replace every live region whose content has changed; nothing else of the page moves.
 * Of calls at once the answer to the last counts: an older one would bring back what was.
 */
export async function refresh() {
  const text = await pageNow();
  if (text === null) return;
  const fresh = new DOMParser().parseFromString(text, 'text/html');
  takeRun(fresh);
  for (const region of document.querySelectorAll('[data-live]')) {
    const next = fresh.querySelector(`[data-live="${region.dataset.live}"]`);
    if (!next) continue;
    region.dataset.open = next.dataset.open ?? '';
    if (next.innerHTML === region.innerHTML) continue;
    const focused = region.contains(document.activeElement) ? place(region) : -1;
    const scrolled = region.scrollTop;
    region.replaceChildren(...document.adoptNode(next).childNodes);
    region.scrollTop = scrolled;
    if (focused >= 0) focusable(region)[focused]?.focus({ preventScroll: true });
  }
}

const focusable = (region) => [...region.querySelectorAll('a[href], button, select, input')];
const place = (region) => focusable(region).indexOf(document.activeElement);

/** Call `work` at once, then at most once in `interval` ms; the last of many calls is not lost. */
export function throttled(work, interval) {
  let busy = false;
  let again = false;
  return async function call() {
    if (busy) {
      again = true;
      return;
    }
    busy = true;
    const started = performance.now();
    try {
      await work();
    } finally {
      const rest = Math.max(0, interval - (performance.now() - started));
      setTimeout(() => {
        busy = false;
        if (again) {
          again = false;
          call();
        }
      }, rest);
    }
  };
}

/** A request whose refusal becomes a Problem with the document's title, detail and errors. */
export async function ask(url, options = {}) {
  let answer;
  let text;
  try {
    answer = await fetch(url, options);
    text = await answer.text();
  } catch {
    throw new Problem({ title: 'No answer', detail: 'the server cannot be reached' });
  }
  const type = answer.headers.get('Content-Type') ?? '';
  const isJson = type.includes('json');
  const body = isJson && text ? JSON.parse(text) : text;
  if (answer.ok) return body;
  throw new Problem(
    type.startsWith(PROBLEM)
      ? body
      : { title: answer.statusText, status: answer.status, detail: `status ${answer.status}` },
  );
}

/** Of several answers the one to the last question counts; to one before it, or a refusal of it, null is heard. */
export function latest(question) {
  let last = 0;
  return async (...given) => {
    const mine = ++last;
    try {
      const found = await question(...given);
      return mine === last ? found : null;
    } catch (error) {
      if (mine !== last) return null;
      throw error;
    }
  };
}

export const put = (url, body) => post(url, body, 'PUT');

export const post = (url, body, method = 'POST') =>
  ask(url, {
    method,
    ...(body === undefined
      ? {}
      : { headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(body) }),
  });

export class Problem extends Error {
  constructor(document) {
    super(document.detail || document.title || 'refused');
    this.document = document;
    this.errors = document.errors ?? [];
  }
}

/** An element with a class and a text; text never becomes markup. */
export function element(tag, text = '', className = '') {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}
