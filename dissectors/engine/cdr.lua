-- CDR bodies by message type. A type is a list of steps, as in edoras_tools.ros.plan: a "run" of primitives at
-- fixed offsets from an aligned start, a "text", or a "repeat" of other steps. Positions are places in the
-- datagram's string, from 1; alignment counts from the body's first byte.

local KINDS = {
	["?"] = "bool", b = "int8", B = "uint8", h = "int16", H = "uint16", i = "int32", I = "uint32",
	q = "int64", Q = "uint64", f = "float", d = "double",
}
local CODES = {
	["?"] = "B", b = "b", B = "B", h = "i2", H = "I2", i = "i4", I = "I4", q = "e", Q = "E", f = "f", d = "d",
}
local MOST_WORDS, MOST_ITEMS = 8, 3  -- what fits in one line
local MOST_AT_ONCE = 64

local function value_field(abbreviation, name, code, array)
	if array and code == "B" then
		return new_field("ros2cdr", abbreviation, "bytes", name)
	elseif code == "?" or code == "f" or code == "d" then
		return new_field("ros2cdr", abbreviation, KINDS[code], name)
	end
	return new_field("ros2cdr", abbreviation, KINDS[code], name, base.DEC)
end

-- A list's number of elements. No ROS field's name begins with an underscore.
local function count_field(path, name)
	return new_field("ros2cdr", path .. "._count", "uint32", name .. " items", base.DEC)
end

-- Give a run of single values one format for them all.
local function compile_run(run)
	local format, position = {}, 0
	for index, leaf in ipairs(run.leaves) do
		if leaf.count or index > MOST_AT_ONCE then return end
		format[#format + 1] = string.rep("x", leaf.offset - position) .. CODES[leaf.code]
		position = leaf.offset + leaf.size
	end
	run.little, run.big = "<" .. table.concat(format), ">" .. table.concat(format)
end

-- Give every leaf its field. Elements have no index in a field's name.
local function compile(steps, prefix, array)
	for _, step in ipairs(steps) do
		if step.leaves then
			for _, leaf in ipairs(step.leaves) do
				local path = prefix .. (leaf.name ~= "" and "." .. leaf.name or "")
				local many = leaf.count ~= nil or (array and leaf.name == "")
				leaf.many = many
				if leaf.count then leaf.counter = count_field(path, leaf.name) end
				leaf.record = value_field(path, leaf.name ~= "" and leaf.name or path:match("[^.]*$"), leaf.code, many)
				leaf.little, leaf.big = "<" .. CODES[leaf.code], ">" .. CODES[leaf.code]
				leaf.said, leaf.in_header = leaf.name .. "=", leaf.name:sub(1, 7) == "header."
			end
			compile_run(step)
		else
			local path = prefix .. (step.name ~= "" and "." .. step.name or "")
			if step.steps then
				step.counter = count_field(path, step.name ~= "" and step.name or path:match("[^.]*$"))
				step.item = new_field("ros2cdr", path .. "._item", "none", "Item")
				compile(step.steps, path, true)
			else
				step.record = new_field("ros2cdr", path, "string", step.name ~= "" and step.name or path:match("[^.]*$"))
			end
		end
	end
end

for name, kind in pairs(D.types) do
	local prefix = "ros2." .. name:gsub("/msg/", "."):gsub("/", ".")
	kind.record = new_field("ros2cdr", prefix, "none", name)
	compile(kind.steps, prefix, false)
end

local function count_at(s, p, start, big)
	p = p + (start - p) % 4
	local b0, b1, b2, b3 = byte(s, p, p + 3)
	if big then b0, b1, b2, b3 = b3, b2, b1, b0 end
	return b0 + 256 * (b1 + 256 * (b2 + 256 * b3)), p + 4
end

-- Return where a body ends, or nil where it is not valid. `stop` is the last place that belongs to it.
local function check(steps, s, p, start, stop, big)
	for index = 1, #steps do
		local step = steps[index]
		if step.leaves then
			p = p + (start - p) % step.alignment + step.size
			if p - 1 > stop then return nil end
		else
			local count = step.count
			if not count then
				if p + (start - p) % 4 + 3 > stop then return nil end
				count, p = count_at(s, p, start, big)
			end
			if step.steps then
				if (step.bound > 0 and count > step.bound) or p + count * step.least - 1 > stop then return nil end
				if step.uniform and count > 0 then
					p = p + (start - p) % step.uniform.alignment + count * step.uniform.size
					if p - 1 > stop then return nil end
				else
					for _ = 1, count do
						p = check(step.steps, s, p, start, stop, big)
						if not p then return nil end
					end
				end
			else
				local narrow = step.width == 1 and 1 or 0
				p = p + count * step.width
				if p - 1 > stop or (narrow == 1 and count > 0 and byte(s, p - 1) ~= 0)
					or (step.bound > 0 and count - narrow > step.bound) then
					return nil
				end
			end
		end
	end
	return p
end

-- Tell whether a body is a message of a type: its end, and at most 3 bytes of padding.
local function is_message(kind, s, start, stop, big)
	if kind.fixed then
		local left = stop - start + 1 - kind.fixed
		return left >= 0 and left <= 3
	end
	local p = check(kind.steps, s, start, start, stop, big)
	return p ~= nil and stop + 1 - p <= 3
end

local function text_value(step, s, p, count, big)
	if step.width == 1 then
		return utf8_text(s:sub(p, p + count - 2))
	end
	return wide_text(s, p, p + count * step.width - 1, step.width, big)
end

-- A primitive in a few characters.
local function short_value(leaf, value)
	local code = leaf.code
	if code == "d" or code == "f" then
		return value ~= value and "nan" or string.format("%.6g", value)
	elseif code == "?" then
		return value ~= 0 and "True" or "False"
	elseif leaf.size == 8 then
		return tostring(value)
	end
	return string.format("%d", value)
end

local function value_at(leaf, s, p, big)
	return (unpack(big and leaf.big or leaf.little, s, p))
end

-- Tell a zero; -0.0 is one too. 64-bit integers are objects, which equal no number.
local function is_zero(leaf, value)
	return value == 0 or ((leaf.code == "q" or leaf.code == "Q") and tostring(value) == "0")
end

local function listed(items, count)
	return "[" .. table.concat(items, ", ") .. (count > MOST_ITEMS and string.format(", ... %d", count) or "") .. "]"
end

local function short_numbers(leaf, s, p, count, big)
	local items = {}
	for index = 1, math.min(count, MOST_ITEMS) do
		items[index] = short_value(leaf, value_at(leaf, s, p + (index - 1) * leaf.size, big))
	end
	return listed(items, count)
end

local short_message

-- Append the words of a list of messages or texts; return where it ends.
local function short_list(step, s, p, start, big)
	local items, count = {}, step.count
	if not count then count, p = count_at(s, p, start, big) end
	if step.element and count > 0 then
		local leaf = step.steps[1].leaves[1]
		p = p + (start - p) % leaf.size
		return short_numbers(leaf, s, p, count, big), p + count * leaf.size
	end
	for index = 1, count do
		if index > MOST_ITEMS then
			p = check(step.steps, s, p, start, #s, big)
		elseif step.unnamed then
			local inner = step.steps[1]
			if inner.steps then
				items[index], p = short_list(inner, s, p, start, big)
				items[index] = items[index] or "[]"
			else
				local length
				length, p = count_at(s, p, start, big)
				items[index] = text_value(inner, s, p, length, big)
				p = p + length * inner.width
			end
		else
			local text
			text, p = short_message(step.steps, s, p, start, big, true)
			items[index] = "{" .. text .. "}"
		end
	end
	return count > 0 and listed(items, count) or nil, p
end

local words, header = {}, {}  -- of the message that is told; lists of messages have their own

local function say(name, value)
	local list = name:sub(1, 7) == "header." and header or words
	list[#list + 1] = name .. "=" .. value
end

-- Say the single values of a run, decoded at once where they can be.
local function say_run(run, s, p, big)
	local values = run.little and {unpack(big and run.big or run.little, s, p)}
	local leaves = run.leaves
	for index = 1, #leaves do
		local leaf, value = leaves[index], values and values[index]
		if leaf.count then
			say(leaf.name, short_numbers(leaf, s, p + leaf.offset, leaf.count, big))
		elseif not leaf.hidden then
			if not values then value = value_at(leaf, s, p + leaf.offset, big) end
			if not is_zero(leaf, value) then
				local list = leaf.in_header and header or words
				list[#list + 1] = leaf.said .. short_value(leaf, value)
			end
		end
	end
end

-- Return a message in a few words: zeros left out, long arrays cut, the header last; and where it ends, which
-- is known only where `whole` is asked for.
function short_message(steps, s, p, start, big, whole)
	local outer_words, outer_header = words, header
	words, header = {}, {}
	for index = 1, #steps do
		local step = steps[index]
		if #words > MOST_WORDS and not whole then break end
		if step.leaves then
			p = p + (start - p) % step.alignment
			say_run(step, s, p, big)
			p = p + step.size
		elseif step.steps then
			local text
			text, p = short_list(step, s, p, start, big)
			if text then say(step.name, text) end
		else
			local length
			length, p = count_at(s, p, start, big)
			if length > (step.width == 1 and 1 or 0) then
				say(step.name, text_value(step, s, p, length, big))
			end
			p = p + length * step.width
		end
	end
	local told, total = words, #words
	for _, word in ipairs(header) do
		total = total + 1
		told[total] = word
	end
	words, header = outer_words, outer_header
	if total == 0 then return "all zero", p end
	if total <= MOST_WORDS then return table.concat(told, " "), p end
	return table.concat(told, " ", 1, MOST_WORDS) .. " ...", p
end

local function show_number(node, leaf, tvb, p, big)
	local range = tvb(p - 1, leaf.size)
	if big then
		node:add(leaf.record.field, range)
	else
		node:add_le(leaf.record.field, range)
	end
end

-- Add the node of a list; return it, or its parent where nobody asks for it.
local function show_count(node, counter, range, name, count, visible)
	if not (visible or counter.on) then return node end
	local list = node:add(counter.field, range, count)
	if visible then list:set_text(string.format("%s: %d items", name, count)) end
	return list
end

local function show_numbers(node, leaf, counter, tvb, p, count, big, name, visible)
	local range = tvb(p - 1, count * leaf.size)
	if leaf.code == "B" then
		if visible or leaf.record.on then node:add(leaf.record.field, range) end
		return
	end
	node = show_count(node, counter, range, name, count, visible)
	if not (visible or leaf.record.on) then return end
	for index = 0, count - 1 do
		show_number(node, leaf, tvb, p + index * leaf.size, big)
	end
end

local show_steps

local function show_list(node, step, tvb, s, p, start, big, visible)
	local from, count = p, step.count
	if not count then count, p = count_at(s, p, start, big) end
	if step.element and count > 0 then
		local leaf = step.steps[1].leaves[1]
		p = p + (start - p) % leaf.size
		show_numbers(node, leaf, step.counter, tvb, p, count, big, step.name, visible)
		return p + count * leaf.size
	end
	local stop = visible and check({step}, s, from, start, #s, big) or p
	local list = show_count(node, step.counter, tvb(from - 1, stop - from), step.name, count, visible)
	for index = 0, count - 1 do
		local item = list
		if (visible or step.item.on) and not step.unnamed then
			stop = visible and check(step.steps, s, p, start, #s, big) or p
			item = list:add(step.item.field, tvb(p - 1, stop - p))
			if visible then item:set_text(string.format("%s[%d]", step.name, index)) end
		end
		p = show_steps(item, step.steps, tvb, s, p, start, big, visible)
	end
	return p
end

-- Add every value of a valid message; return where it ends.
function show_steps(node, steps, tvb, s, p, start, big, visible)
	for index = 1, #steps do
		local step = steps[index]
		if step.leaves then
			p = p + (start - p) % step.alignment
			for place = 1, #step.leaves do
				local leaf = step.leaves[place]
				if leaf.count then
					show_numbers(node, leaf, leaf.counter, tvb, p + leaf.offset, leaf.count, big, leaf.name, visible)
				elseif visible or leaf.record.on then
					show_number(node, leaf, tvb, p + leaf.offset, big)
				end
			end
			p = p + step.size
		elseif step.steps then
			p = show_list(node, step, tvb, s, p, start, big, visible)
		else
			local from, length = p + (start - p) % 4, nil
			length, p = count_at(s, p, start, big)
			if visible or step.record.on then
				local range = tvb(from - 1, 4 + length * step.width)
				node:add(step.record.field, range, text_value(step, s, p, length, big))
			end
			p = p + length * step.width
		end
	end
	return p
end
