// Lists: rows that are ticked to be compared.

/** Enable the button of a form that compares once two of its rows are ticked. */
function countTicks(form) {
  form.querySelector('button:not([type="button"])').disabled = form.querySelectorAll('[name="run"]:checked').length < 2;
}

const countAllTicks = () => document.querySelectorAll('[data-compare]').forEach(countTicks);

document.addEventListener('change', ({ target }) => {
  const form = target.closest('[data-compare]');
  if (form) countTicks(form);
});
document.addEventListener('refreshed', countAllTicks);
addEventListener('pageshow', countAllTicks); // the browser restores ticks
