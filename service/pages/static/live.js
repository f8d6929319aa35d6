// Regions marked data-live are replaced from the page itself, so that one template draws them.

const PROBLEM = 'application/problem+json';

/** Replace the shown run if another run of the sweep is now the best, or if it has ended. */
function replaceRun(fresh) {
  const [current, next] = [document, fresh].map((root) => root.getElementById('run'));
  if (current && next && current.dataset.run !== next.dataset.run) current.replaceWith(document.adoptNode(next.cloneNode(true)));
}

const fetchPage = keepLatest(() => ask(location.href, { headers: { Accept: 'text/html' } }));

/**
 * Replace every live region whose content has changed; nothing else of the page moves. Ticked runs stay ticked.
 * If calls overlap, only the answer to the last one is used. An earlier answer may be outdated.
 */
export async function refresh() {
  const text = await fetchPage();
  if (text === null) return;
  const fresh = new DOMParser().parseFromString(text, 'text/html');
  replaceRun(fresh);
  for (const region of document.querySelectorAll('[data-live]')) {
    const next = fresh.querySelector(`[data-live="${region.dataset.live}"]`);
    if (!next) continue;
    region.dataset.open = next.dataset.open ?? '';
    if (next.innerHTML === region.innerHTML) continue;
    const focused = region.contains(document.activeElement) ? findFocus(region) : -1;
    const { scrollTop, value } = region;
    const ticked = [...region.querySelectorAll(':checked[name="run"]')].map((box) => box.value);
    region.replaceChildren(...document.adoptNode(next).childNodes);
    region.scrollTop = scrollTop;
    if (region.matches('select') && [...region.options].some((option) => option.value === value)) region.value = value;
    for (const box of region.querySelectorAll('[type="checkbox"][name="run"]')) box.checked = ticked.includes(box.value);
    if (focused >= 0) listFocusable(region)[focused]?.focus({ preventScroll: true });
  }
  document.dispatchEvent(new Event('refreshed'));
}

const listFocusable = (region) => [...region.querySelectorAll('a[href], button, select, input')];
const findFocus = (region) => listFocusable(region).indexOf(document.activeElement);

/** Call `work` at once, then at most once per `interval` ms. The last of several calls is not lost. */
export function throttle(work, interval) {
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

/** The address of a path of the service, which may lie under a prefix behind a proxy. */
export const address = (path) => new URL(`..${path}`, import.meta.url).href;

/** Send a request. A refusal becomes a Problem with the document's title, detail and errors. */
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

/** Ask and wait without a promise, for a browser that prints; null if there is no good answer. */
export function askAtOnce(url) {
  const request = new XMLHttpRequest();
  request.open('GET', url, false);
  try {
    request.send();
    return request.status === 200 ? JSON.parse(request.responseText) : null;
  } catch {
    return null; // the server cannot be reached
  }
}

/** Wrap `question`: if calls overlap, only the last one gets its answer, and earlier ones get null. */
export function keepLatest(question) {
  let latest = 0;
  return async (...args) => {
    const number = ++latest;
    try {
      const answer = await question(...args);
      return number === latest ? answer : null;
    } catch (error) {
      if (number !== latest) return null;
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

/** Make an element with a class and a text. Text never becomes markup. */
export function makeElement(tag, text = '', className = '') {
  const node = document.createElement(tag);
  node.textContent = text;
  if (className) node.className = className;
  return node;
}
