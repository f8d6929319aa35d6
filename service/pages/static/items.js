// Dialogs of a page, and those that edit and delete the item it shows.

import { Problem, ask, makeElement } from './live.js';

const PRECONDITION_FAILED = 412;

document.addEventListener('click', ({ target }) => {
  const button = target.closest('button');
  if (button?.dataset.dialog) document.getElementById(button.dataset.dialog).showModal();
  else if (button && 'close' in button.dataset) button.closest('dialog').close();
});

document.addEventListener('submit', async (event) => {
  const form = event.target;
  const work = form.dataset.edit ? save : form.dataset.delete ? remove : null;
  if (!work) return;
  event.preventDefault();
  const fault = form.querySelector('.fault');
  const button = form.querySelector('button:not([type="button"])');
  fault.textContent = '';
  button.disabled = true;
  try {
    await work(form);
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    button.disabled = false;
    if (!showDependents(form, button, error.document.dependents)) fault.textContent = explain(error);
  }
});

/** Save name, note and tags, unless somebody has changed them since the page was loaded. */
async function save(form) {
  const { name, note, tags } = form.elements;
  const body = {
    ...(name ? { name: name.value.trim() } : {}),
    note: note.value.trim() || null,
    tags: tags.value.split(',').map((tag) => tag.trim()).filter(Boolean),
  };
  const headers = { 'Content-Type': 'application/json', 'If-Match': form.dataset.etag };
  await ask(form.dataset.edit, { method: 'PATCH', headers, body: JSON.stringify(body) });
  const { named } = form.dataset; // the address of an item that is found by its name
  if (named) location.assign(`${named}${encodeURIComponent(name.value.trim())}`);
  else location.reload();
}

/** Delete the item; once its dependents were shown, with all of them. */
async function remove(form) {
  const query = form.dataset.cascade ? '?cascade=true' : '';
  await ask(`${form.dataset.delete}${query}`, { method: 'DELETE' });
  location.assign(form.dataset.after);
}

/** List what was made from the item, and let the next confirmation delete it too. */
function showDependents(form, button, dependents) {
  if (!dependents) return false;
  const list = form.querySelector('[data-dependents]');
  list.replaceChildren(makeElement('li', 'These were made from it:'));
  for (const { kind, id, name } of dependents) {
    const row = document.createElement('li');
    row.append(makeElement('span', kind, 'kind'), makeElement('span', `${name} (${id})`));
    list.append(row);
  }
  list.hidden = false;
  form.dataset.cascade = 'true';
  button.textContent = `Delete it and these ${dependents.length}`;
  return true;
}

const explain = (error) =>
  error.document.status === PRECONDITION_FAILED
    ? 'Somebody has changed it meanwhile. Reload the page, and edit it again.'
    : error.errors.map(({ detail }) => detail).join('; ') || error.message;
