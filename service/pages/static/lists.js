// Lists: rows that are ticked to be compared, and the order of the rows that are shown.

let order = null; // of the sortable list: column and direction

/** Enable the button of a form that compares once two of its rows are ticked. */
function countTicks(form) {
  form.querySelector('button:not([type="button"])').disabled = form.querySelectorAll('[name="run"]:checked').length < 2;
}

const countAllTicks = () => document.querySelectorAll('[data-compare]').forEach(countTicks);

const readValue = (row, column) => {
  const cell = row.cells[column];
  const text = cell.dataset.value ?? cell.textContent.trim();
  return text === '' || text === '–' ? null : Number.isNaN(Number(text)) ? text.toLowerCase() : Number(text);
};

/** Compare two values. Rows without one come last in both directions. */
function compare(a, b, direction) {
  if (a === null || b === null) return (a === null) - (b === null);
  const areNumbers = typeof a === 'number' && typeof b === 'number';
  return direction * (areNumbers ? a - b : String(a).localeCompare(String(b)));
}

/** Order the rows of the sortable list as the user chose. */
function sortRows() {
  const table = document.querySelector('[data-sortable]');
  if (!table || !order) return;
  const { column, direction } = order;
  const headings = table.tHead.rows[0].cells;
  for (const heading of headings) if (heading.ariaSort) heading.ariaSort = 'none';
  headings[column].ariaSort = direction > 0 ? 'ascending' : 'descending';
  const body = table.tBodies[0];
  body.append(...[...body.rows].sort((a, b) => compare(readValue(a, column), readValue(b, column), direction)));
}

document.addEventListener('click', ({ target }) => {
  const heading = target.closest('[data-sort]')?.closest('th');
  if (!heading) return;
  order = { column: heading.cellIndex, direction: heading.ariaSort === 'ascending' ? -1 : 1 };
  sortRows();
});
document.addEventListener('change', ({ target }) => {
  const form = target.closest('[data-compare]');
  if (form) countTicks(form);
});
document.addEventListener('refreshed', () => {
  sortRows();
  countAllTicks();
});
addEventListener('pageshow', countAllTicks); // the browser restores ticks
