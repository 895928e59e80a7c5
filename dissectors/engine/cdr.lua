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
local MOST_AT_ONCE = 64

local records  -- of the type that is compiled

local function ros_field(abbreviation, kind, ...)
	local record = new_field("ros2cdr", abbreviation, kind, ...)
	records[#records + 1] = record
	return record
end

local function value_field(abbreviation, name, code, array)
	if array and code == "B" then
		return ros_field(abbreviation, "bytes", name)
	elseif code == "?" or code == "f" or code == "d" then
		return ros_field(abbreviation, KINDS[code], name)
	end
	return ros_field(abbreviation, KINDS[code], name, base.DEC)
end

-- A list's number of elements. No ROS field's name begins with an underscore.
local function count_field(path, name)
	return ros_field(path .. "._count", "uint32", name .. " items", base.DEC)
end

-- How a leaf's value is said in a few words, as a format: numbers only, and "nan" has its own spelling.
local function format_of_words(leaf)
	if leaf.code == "?" then return leaf.name .. "=True" end
	return leaf.name .. (leaf.code:find("[fd]") and "=%.6g" or "=%d")
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
				leaf.field, leaf.form, leaf.in_header = leaf.record.field, format_of_words(leaf), leaf.name:sub(1, 7) == "header."
				leaf.wide = leaf.code == "q" or leaf.code == "Q"  -- objects, which equal no number
			end
			compile_run(step)
		else
			local path = prefix .. (step.name ~= "" and "." .. step.name or "")
			if step.steps then
				step.counter = count_field(path, step.name ~= "" and step.name or path:match("[^.]*$"))
				step.item = ros_field(path .. "._item", "none", "Item")
				compile(step.steps, path, true)
			else
				step.record = ros_field(path, "string", step.name ~= "" and step.name or path:match("[^.]*$"))
			end
		end
	end
end

for name, kind in pairs(D.types) do
	local prefix = "ros2." .. name:gsub("/msg/", "."):gsub("/", ".")
	kind.records = {}
	records = kind.records
	kind.record = ros_field(prefix, "none", name)
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

-- Return how many bytes follow a body's last field, or nil where it is no message of this type.
local function bytes_left(kind, s, start, stop, big)
	if kind.fixed then
		local left = stop - start + 1 - kind.fixed
		return left >= 0 and left or nil
	end
	local p = check(kind.steps, s, start, start, stop, big)
	return p and stop + 1 - p
end
